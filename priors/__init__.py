"""Learned models: what motion is natural."""

from typing import TYPE_CHECKING

from mapctl.errors import CheckpointError
from mapctl.lazy import import_lazily
from priors import checkpoints, weight_sets
from priors.weight_sets import add_set as add_set
from priors.weight_sets import use_weights as use_weights

if TYPE_CHECKING:
    from priors.denoiser import ConvDenoiser as ConvDenoiser
    from priors.infiller import ConvInfiller as ConvInfiller
    from priors.keyframe_timing import KeyframeTiming as KeyframeTiming
    from priors.lstm_gmm.density import LstmGmmDensity as LstmGmmDensity
    from priors.path import ConvPathPredictor as ConvPathPredictor
    from priors.pose_transformer import PoseTransformer as PoseTransformer
    from priors.refiner import LstmRefiner as LstmRefiner
    from priors.stitcher import Stitcher as Stitcher
    from priors.tweener import Tweener as Tweener

# A walk needs one of these models, and all of them take longer to import than a second of it takes to solve.
_HOMES = {
    "ConvDenoiser": "denoiser",
    "ConvInfiller": "infiller",
    "KeyframeTiming": "keyframe_timing",
    "LstmGmmDensity": "lstm_gmm.density",
    "PoseTransformer": "pose_transformer",
    "LstmRefiner": "refiner",
    "Stitcher": "stitcher",
    "Tweener": "tweener",
    "ConvPathPredictor": "path",
}
_find_class, __dir__ = import_lazily(__name__, {name: f"priors.{home}" for name, home in _HOMES.items()}, {}, globals())
__getattr__ = _find_class

AUTO = ("locomotion", "general")
"""Bundled densities that `auto` chooses from, by likelihood (see mapctl.problem.density_selection): those of them that
the set of weights in force has."""


def has_model(name: str) -> bool:
    """Return whether the set of weights in force has a model of this bundled name, or one that stands in for it."""
    return weight_sets.find_file(name) is not None


def load(name: str) -> "LstmGmmDensity":
    """Load a bundled prior by name (`locomotion`), or a trained one by its file or run folder."""
    return _find_class("LstmGmmDensity").load(name)


def load_choice(name: str | None) -> "list[LstmGmmDensity]":
    """Load the densities that a --prior leaves to choose from: the bundled ones for `auto`, else the named one."""
    if name != "auto":
        return [] if name is None else [load(name)]
    there = weight_sets.list_models()
    return [load(each) for each in [each for each in AUTO if each in there] or AUTO]  # a missing one raises the error


def load_refiner(name: str) -> "LstmRefiner":
    """Load a bundled refiner by name (`locomotion-refiner`), or a trained one by its file or run folder."""
    return _find_class("LstmRefiner").load(name)


def load_denoiser(name: str = "denoiser") -> "ConvDenoiser":
    """Load the bundled denoiser, or a trained one by its file or run folder."""
    return _find_class("ConvDenoiser").load(name)


def load_infiller(name: str) -> "ConvInfiller":
    """Load a trained infiller by its file or run folder."""
    return _find_class("ConvInfiller").load(name)


def load_inbetweener(
    name: str = "transformer", path: str = "path"
) -> "ConvInfiller | PoseTransformer | Tweener | Stitcher":
    """Load the bundled pose transformer, tweener or stitcher, or a trained one, or a trained infiller, by its file or
    run folder; CheckpointError for anything else. A tweener goes by the path predictor `path`."""
    kind = find_inbetweener_kind(name)
    return load_tweener(name, path) if kind == "tweener" else _INBETWEENERS[kind](name)


def find_inbetweener_kind(name: str) -> str:
    """The kind of a bundled or trained in-betweener, from its card: `pose-transformer`, `infiller`, `tweener` or
    `stitcher`; CheckpointError for anything else."""
    kind = find_kind(name)
    if kind not in (*_INBETWEENERS, "tweener"):
        raise CheckpointError(f"{checkpoints.locate(name)}: a {kind} is no in-betweener")
    return kind


def find_kind(name: str) -> str:
    """Find the kind of a bundled or trained model, from its card, as `mapctl train` calls it."""
    return checkpoints.read_card(checkpoints.locate(name).with_suffix(".json")).kind


def load_transformer(name: str = "transformer") -> "PoseTransformer":
    """Load the bundled pose transformer, or a trained one by its file or run folder."""
    return _find_class("PoseTransformer").load(name)


def load_tweener(name: str = "tweener", path: str = "path") -> "Tweener":
    """Load the bundled generator of long in-betweens, or a trained one by its file or run folder, with the path
    predictor that it was trained with."""
    return _find_class("Tweener").load(name, path)


def load_stitcher(name: str = "stitcher") -> "Stitcher":
    """Load the bundled stitcher, which fills short gaps in variations, or a trained one by its file or run folder."""
    return _find_class("Stitcher").load(name)


def load_path(name: str = "path") -> "ConvPathPredictor":
    """Load the bundled path predictor, or a trained one by its file or run folder."""
    return _find_class("ConvPathPredictor").load(name)


def load_keyframe_timing(name: str = "keyframe-timing") -> "KeyframeTiming":
    """Load the bundled timing of keyframes, or a trained one by its file or run folder."""
    return _find_class("KeyframeTiming").load(name)


def refiner_of(prior: str, name: str = "auto") -> "LstmRefiner | None":
    """Load the refiner of that name; for `auto` the bundled one of a bundled prior, if it has one."""
    if name != "auto":
        return load_refiner(name)
    own = f"{prior}-refiner"
    return None if weight_sets.find_file(own) is None else load_refiner(own)


_INBETWEENERS = {"infiller": load_infiller, "pose-transformer": load_transformer, "stitcher": load_stitcher}
