"""`mapctl bench`: cost of the solver and of walks on this machine."""

from dataclasses import dataclass
from typing import ClassVar

from mapctl.commands.shared import options
from mapctl.commands.shared.command import ModelCommand


@dataclass(frozen=True)
class Bench(ModelCommand):
    """Cost on this machine: energy and gradient of a window, fast path and reference; following a curve; steering."""

    tells_licence: ClassVar[bool] = False

    prior: options.Name = "locomotion"
    """A bundled prior, or the file or run folder of a trained one."""
    live: options.Name = "locomotion-live"
    """The prior that is steered: a bundled one, or the file or run folder of a trained one."""
    json: bool = False
    """Print JSON instead of a table."""
