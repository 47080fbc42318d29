"""mapctl: human motion by optimisation. A learned prior scores how natural a motion is, weighted terms how well it
meets the request."""

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

# torch takes a second to import; `mapctl --help` must not wait for it, so public names arrive on first use.
_SUBMODULES = (
    *("curves", "editing", "errors", "features", "formats", "inbetweening", "metrics", "motion_dna", "pose"),
    *("protocols", "recording", "report", "retarget", "terms"),
)
_HOMES = {"load": "formats", "Motion": "motion", "Skeleton": "skeleton", "CANONICAL": "skeleton"}


def __getattr__(name: str):
    if name in _SUBMODULES:
        return import_module(f"mapctl.{name}")
    if name not in _HOMES:
        raise AttributeError(f"module 'mapctl' has no attribute {name!r}")
    return getattr(import_module(f"mapctl.{_HOMES[name]}"), name)


def __dir__() -> list[str]:
    """Return the public names, which arrive on first use; what was imported for them is not meant for users."""
    return sorted([*_HOMES, *_SUBMODULES, "__version__"])
