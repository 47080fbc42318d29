"""Learned models: what motion is natural."""

from mapctl.errors import CheckpointError
from priors import checkpoints
from priors.denoiser import network as denoiser_network
from priors.denoiser.network import ConvDenoiser
from priors.infiller import network as infiller_network
from priors.infiller.network import ConvInfiller
from priors.keyframe_timing import model as keyframe_timing
from priors.keyframe_timing.model import KeyframeTiming
from priors.lstm_gmm import density
from priors.lstm_gmm.density import LstmGmmDensity
from priors.pose_transformer import inbetweener as pose_transformer
from priors.pose_transformer.inbetweener import PoseTransformer
from priors.refiner import network as refiner_network
from priors.refiner.network import LstmRefiner
from priors.stitching import inbetweener as stitching
from priors.stitching.inbetweener import Stitcher
from priors.tweening import inbetweener as tweening
from priors.tweening import path as path_network
from priors.tweening.inbetweener import Tweener
from priors.tweening.path import ConvPathPredictor

AUTO = ("locomotion", "general")
"""Bundled densities that `auto` chooses from, by likelihood (see mapctl.problem.density_selection)."""


def load(name: str) -> LstmGmmDensity:
    """A bundled prior by name (`locomotion`), or a trained one by its file or run folder."""
    return density.load(name)


def load_choice(name: str | None) -> list[LstmGmmDensity]:
    """The densities that a --prior leaves to choose from: for `auto` the bundled ones, else the named one, or none."""
    if name is None:
        return []
    return [load(each) for each in (AUTO if name == "auto" else (name,))]


def load_refiner(name: str) -> LstmRefiner:
    """A bundled refiner by name (`locomotion-refiner`), or a trained one by its file or run folder."""
    return refiner_network.load(name)


def load_denoiser(name: str = "denoiser") -> ConvDenoiser:
    """The bundled denoiser, or a trained one by its file or run folder."""
    return denoiser_network.load(name)


def load_infiller(name: str) -> ConvInfiller:
    """A trained infiller by its file or run folder."""
    return infiller_network.load(name)


def load_inbetweener(
    name: str = "transformer", path: str = "path"
) -> ConvInfiller | PoseTransformer | Tweener | Stitcher:
    """The bundled pose transformer, tweener or stitcher, or a trained one, or a trained infiller, by its file or run
    folder; CheckpointError for anything else. A tweener goes by the path predictor `path`."""
    kind = find_inbetweener_kind(name)
    return load_tweener(name, path) if kind == "tweener" else _INBETWEENERS[kind](name)


def find_inbetweener_kind(name: str) -> str:
    """The kind of a bundled or trained in-betweener, from its card: `pose-transformer`, `infiller`, `tweener` or
    `stitcher`; CheckpointError for anything else."""
    found = checkpoints.locate(name)
    kind = checkpoints.read_card(found.with_suffix(".json")).kind
    if kind not in (*_INBETWEENERS, "tweener"):
        raise CheckpointError(f"{found}: a {kind} is no in-betweener")
    return kind


def load_transformer(name: str = "transformer") -> PoseTransformer:
    """The bundled pose transformer, or a trained one by its file or run folder."""
    return pose_transformer.load(name)


def load_tweener(name: str = "tweener", path: str = "path") -> Tweener:
    """The bundled generator of long in-betweens, or a trained one by its file or run folder, with the path predictor
    that it was trained with."""
    return tweening.load(name, path)


def load_stitcher(name: str = "stitcher") -> Stitcher:
    """The bundled stitcher, which fills short gaps in many ways, or a trained one by its file or run folder."""
    return stitching.load(name)


def load_path(name: str = "path") -> ConvPathPredictor:
    """The bundled path predictor, or a trained one by its file or run folder."""
    return path_network.load(name)


def load_keyframe_timing(name: str = "keyframe-timing") -> KeyframeTiming:
    """The bundled timing of keyframes, or a trained one by its file or run folder."""
    return keyframe_timing.load(name)


def refiner_of(prior: str, name: str = "auto") -> LstmRefiner | None:
    """The refiner of that name; for `auto` the bundled one of a bundled prior, if it has one."""
    if name != "auto":
        return load_refiner(name)
    own = f"{prior}-refiner"
    return load_refiner(own) if own in checkpoints.list_bundled() else None


_INBETWEENERS = {"infiller": load_infiller, "pose-transformer": load_transformer, "stitcher": load_stitcher}
