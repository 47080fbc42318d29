"""`mapctl info`: what is installed: priors and their cards, scenes, versions, rendering, threads; or what a clip is."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, ClassVar

from tyro.conf import Positional, arg

from mapctl.commands.shared import options
from mapctl.commands.shared.command import ModelCommand


@dataclass(frozen=True)
class Info(ModelCommand, options.RigOptions):
    """Bundled priors with their cards and licences, scenes, versions, rendering back end, threads; or a clip's rig."""

    tells_licence: ClassVar[bool] = False

    single_thread: ClassVar[bool] = False

    name: Positional[Annotated[str | None, arg(metavar="NAME|CLIP")]] = None
    """A prior whose whole card is printed, as JSON: bundled, a file, or a run folder. Or a clip in
    any format that `mapctl convert` reads, of which rig, joints, unit, axes and length are printed, and whether the fit
    is sure, doubtful or refused, with reasons."""
    out: Annotated[Path | None, arg(aliases=["-o"], metavar="FILE.png")] = None
    """A picture of a clip's rig: its T-pose with both names of each joint, two frames, axes, and what is doubtful."""
    json: bool = False
    """Print JSON instead of tables."""
