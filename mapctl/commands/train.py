"""`mapctl train`: a model from a folder of BVH. The options of a model are the settings of its recipe, in
`priors.training.recipes`.
"""

from dataclasses import dataclass
from importlib import import_module

RECIPES = {
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
"""Settings of trainable models by their name in `mapctl train`."""


def load_recipe(name: str) -> type:
    """Import the recipe of a model and return its settings."""
    return getattr(import_module(f"priors.training.recipes.{name.replace('-', '_')}"), RECIPES[name])


@dataclass(frozen=True)
class Train:
    """Train a model on a folder of BVH; an interrupted run continues from its last checkpoint."""
