"""mapctl: human motion by optimisation. A learned prior scores how natural a motion is, weighted terms how well it
meets the request."""

from typing import TYPE_CHECKING

from mapctl.lazy import import_lazily
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
__getattr__, __dir__ = import_lazily(
    __name__,
    {name: f"mapctl.{home}" for name, home in _HOMES.items()},
    {name: f"mapctl.{name}" for name in _SUBMODULES},
    ["__version__"],
)
