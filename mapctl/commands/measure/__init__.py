"""`mapctl measure`: the measures of a motion, or of a folder of them, beside those of a reference and of mocap."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, ClassVar

from tyro.conf import Positional, arg

from mapctl.commands.shared import options
from mapctl.commands.shared.command import ModelCommand


@dataclass(frozen=True)
class Measure(ModelCommand, options.RigOptions):
    """Path, feet, jitter and more of a motion, beside a reference clip and mocap's own values.

    Of a clip also its cycle, of a walk or a run one stride, or that it has none.
    All are measured as mocap's values were: on canonical joints with Y up, at 30 frames a second if there are more. Of
    a folder the means over its clips; beside a folder of mocap also whether the two can be told apart. Clips of a
    folder that cannot be measured are left out and listed.
    """

    tells_licence: ClassVar[bool] = False

    clip: Positional[Annotated[Path, arg(metavar="CLIP|FOLDER")]]
    """A motion in any format that mapctl reads; or a folder, every one below it."""
    reference: Annotated[Path | None, arg(metavar="CLIP|FOLDER")] = None
    """Another clip to print beside it; or for a folder another, unseen mocap say: adds realism and diversity."""
    curve: options.MaybeCurve = None
    """Curve that it was to follow: circle:4, a CSV, an SVG (see `mapctl follow --help`)."""
    speed: options.MaybeNumber = None
    """Requested speed, m/s: adds the progress along the curve."""
    metres_per_unit: options.MaybeNumber = None
    """Scale of a CSV or SVG file."""
    json: bool = False
    """Print JSON instead of a table."""
