"""The sub-commands, a module each, imported when its command is used. Part of the command line: like `mapctl.cli` they
may import every package, and nothing else imports them.
"""

from collections.abc import Iterator, Mapping
from importlib import import_module
from typing import Protocol, runtime_checkable

from mapctl.commands.train import KINDS


@runtime_checkable
class Runnable(Protocol):
    """Protocol of sub-commands."""

    def run(self) -> int:
        """Do the work and return the exit status; MapctlError for what is wrong with the request."""
        ...


_CLASSES = {
    "demo": "Demo",
    "follow": "FollowCurve",
    "run": "RunScene",
    "generate": "Generate",
    "steer": "Steer",
    "live": "Live",
    "denoise": "Denoise",
    "infill": "Infill",
    "tween": "Tween",
    "blend": "Blend",
    "chain": "Chain",
    "render": "Render",
    "convert": "Convert",
    "measure": "Measure",
    "train": "Train",
    "info": "Info",
    "compile": "CompileKernels",
    "blender-addon": "BlenderAddon",
    "bench": "Bench",
}


class _Commands(Mapping[str, type[Runnable]]):
    """Classes of options by the name of their command, imported when they are asked for."""

    def __getitem__(self, name: str) -> type[Runnable]:
        kind = _CLASSES[name]
        return getattr(import_module(f"{__name__}.{name.replace('-', '_')}"), kind)

    def __iter__(self) -> Iterator[str]:
        return iter(_CLASSES)

    def __len__(self) -> int:
        return len(_CLASSES)


COMMANDS: Mapping[str, type[Runnable]] = _Commands()
"""Sub-commands by the name the user types, in the order of the help."""
SUBCOMMANDS: dict[str, Mapping[str, type[Runnable]]] = {"train": KINDS}
"""The sub-commands of commands that have some."""
MANY_THREADS = {"blender-addon", "convert", "info", "render", "train"}
"""Commands that compute with as many threads as there are, or decide it themselves."""
