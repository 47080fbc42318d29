"""`mapctl train`: a model from a folder of BVH. The options of a model are the settings of its recipe, in
`priors.training.recipes`.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from importlib import import_module

_RECIPES = {
    "lstm-gmm": "DensitySettings",
    "refiner": "RefinerSettings",
    "denoiser": "DenoiserSettings",
    "pose-transformer": "PoseTransformerSettings",
    "infiller": "InfillerSettings",
    "keyframe-timing": "KeyframeTimingSettings",
    "path": "PathSettings",
    "tweener": "TweenerSettings",
    "stitcher": "StitcherSettings",
}


class _Kinds(Mapping[str, type]):
    """Settings by the name of the model; a recipe is imported when it is looked up."""

    def __getitem__(self, name: str) -> type:
        return getattr(import_module(f"priors.training.recipes.{name.replace('-', '_')}"), _RECIPES[name])

    def __iter__(self) -> Iterator[str]:
        return iter(_RECIPES)

    def __len__(self) -> int:
        return len(_RECIPES)

    def __contains__(self, name: object) -> bool:
        return name in _RECIPES


KINDS = _Kinds()
"""Trainable models by their name in `mapctl train`."""


@dataclass(frozen=True)
class Train:
    """Train a model on a folder of BVH; an interrupted run continues from its last checkpoint."""
