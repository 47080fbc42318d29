"""The sub-commands, a package each. Part of the command line: like `mapctl.cli` they may import every package,
and nothing else imports them.

A package holds a frozen dataclass of options, which imports nothing heavy; the work is in its module `run`, imported
when it runs, by `mapctl.commands.shared.command` alone.
"""

from collections.abc import Mapping
from typing import Protocol, runtime_checkable

from mapctl.commands.bench import Bench
from mapctl.commands.blend import Blend
from mapctl.commands.blender_addon import BlenderAddon
from mapctl.commands.chain import Chain
from mapctl.commands.compile import CompileKernels
from mapctl.commands.convert import Convert
from mapctl.commands.demo import Demo
from mapctl.commands.denoise import Denoise
from mapctl.commands.follow import FollowCurve
from mapctl.commands.generate import Generate
from mapctl.commands.infill import Infill
from mapctl.commands.info import Info
from mapctl.commands.live import Live
from mapctl.commands.measure import Measure
from mapctl.commands.render import Render
from mapctl.commands.run import RunScene
from mapctl.commands.steer import Steer
from mapctl.commands.train import KINDS, Train
from mapctl.commands.tween import Tween


@runtime_checkable
class Runnable(Protocol):
    """Protocol of sub-commands."""

    def run(self) -> int:
        """Do the work and return the exit status; MapctlError for what is wrong with the request."""
        ...


COMMANDS: dict[str, type[Runnable]] = {
    "demo": Demo,
    "follow": FollowCurve,
    "run": RunScene,
    "generate": Generate,
    "steer": Steer,
    "live": Live,
    "denoise": Denoise,
    "infill": Infill,
    "tween": Tween,
    "blend": Blend,
    "chain": Chain,
    "render": Render,
    "convert": Convert,
    "measure": Measure,
    "train": Train,
    "info": Info,
    "compile": CompileKernels,
    "blender-addon": BlenderAddon,
    "bench": Bench,
}
"""Sub-commands by the name the user types, in the order of the help."""
SUBCOMMANDS: dict[str, Mapping[str, type[Runnable]]] = {"train": KINDS}
"""The sub-commands of commands that have some."""
