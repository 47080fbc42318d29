"""mapctl: human motion by optimisation. A learned prior says what is natural, terms say what is wanted."""

from importlib import import_module
from typing import TYPE_CHECKING

from mapctl.version import __version__ as __version__

if TYPE_CHECKING:
    from mapctl import curves as curves
    from mapctl import editing as editing
    from mapctl import errors as errors
    from mapctl import features as features
    from mapctl import formats as formats
    from mapctl import inbetweening as inbetweening
    from mapctl import metrics as metrics
    from mapctl import motion_dna as motion_dna
    from mapctl import pose as pose
    from mapctl import protocols as protocols
    from mapctl import recording as recording
    from mapctl import report as report
    from mapctl import retarget as retarget
    from mapctl import terms as terms
    from mapctl.formats import load as load
    from mapctl.motion import Motion as Motion
    from mapctl.skeleton import CANONICAL as CANONICAL
    from mapctl.skeleton import Skeleton as Skeleton

__all__ = [
    "CANONICAL",
    "Motion",
    "Skeleton",
    "__version__",
    "curves",
    "editing",
    "errors",
    "features",
    "formats",
    "inbetweening",
    "load",
    "metrics",
    "motion_dna",
    "pose",
    "protocols",
    "recording",
    "report",
    "retarget",
    "terms",
]

# torch takes a second to import; `mapctl --help` must not wait for it, so public names arrive on first use.
_HOMES = {
    "load": "mapctl.formats",
    "Motion": "mapctl.motion",
    "Skeleton": "mapctl.skeleton",
    "CANONICAL": "mapctl.skeleton",
    "curves": "mapctl.curves",
    "editing": "mapctl.editing",
    "errors": "mapctl.errors",
    "features": "mapctl.features",
    "formats": "mapctl.formats",
    "inbetweening": "mapctl.inbetweening",
    "metrics": "mapctl.metrics",
    "motion_dna": "mapctl.motion_dna",
    "pose": "mapctl.pose",
    "protocols": "mapctl.protocols",
    "recording": "mapctl.recording",
    "report": "mapctl.report",
    "retarget": "mapctl.retarget",
    "terms": "mapctl.terms",
}


def __getattr__(name: str):
    if name not in _HOMES:
        raise AttributeError(f"module 'mapctl' has no attribute {name!r}")
    module = import_module(_HOMES[name])
    return module if _HOMES[name] == f"mapctl.{name}" else getattr(module, name)


def __dir__() -> list[str]:
    """Return the public names, which arrive on first use; what was imported for them is not meant for users."""
    return __all__
