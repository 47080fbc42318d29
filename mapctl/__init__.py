"""mapctl: human motion by optimisation. A learned prior says what is natural, terms say what is wanted."""

from importlib import import_module
from typing import TYPE_CHECKING

from mapctl.runtime import saving
from mapctl.version import __version__ as __version__

if TYPE_CHECKING:
    from mapctl import curves as curves
    from mapctl.formats import load as load
    from mapctl.motion import Motion as Motion
    from mapctl.skeleton import CANONICAL as CANONICAL
    from mapctl.skeleton import Skeleton as Skeleton

# torch takes a second to import; `mapctl --help` must not wait for it, so public names arrive on first use.
_MODULE_OF = {
    "load": "mapctl.formats",
    "Motion": "mapctl.motion",
    "Skeleton": "mapctl.skeleton",
    "CANONICAL": "mapctl.skeleton",
    "curves": "mapctl.curves",
}

saving.register_writer(lambda motion, path: import_module("mapctl.formats").save(motion, path))


def __getattr__(name: str):
    if name not in _MODULE_OF:
        raise AttributeError(f"module 'mapctl' has no attribute {name!r}")
    module = import_module(_MODULE_OF[name])
    return module if _MODULE_OF[name] == f"mapctl.{name}" else getattr(module, name)
