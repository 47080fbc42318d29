"""`mapctl make`: clips that a model and the solver make, as further training data."""

from dataclasses import dataclass
from typing import Annotated

from tyro.conf import arg

from mapctl.commands.shared import options
from mapctl.commands.shared.command import ModelCommand


@dataclass(frozen=True)
class Make(ModelCommand):
    """Motion that data lack, steered: starts, stops, turns on the spot, changes of pace; kept where it passes checks.

    Clips that are as good as mocap by every check go to OUT/made_000.bvh and so on, and can be trained on beside it;
    OUT/made.csv lists all that were made, by which model, and why some were not kept.
    """

    out: options.OutFolder
    """Folder for the clips and their list; made if it does not exist."""
    reference: options.DataFolder
    """Folder of mocap (.bvh) whose ranges the clips are held to."""
    prior: options.Name = "locomotion"
    """Who makes them: a bundled prior, or the file or run folder of a trained one."""
    count: options.Count = 20
    """Clips to make; fewer are kept."""
    seconds: options.Number = 10.0
    """Length of each."""
    seed: options.Count = 0
    """Seed of the scripts and first poses."""
    match: Annotated[str, arg(metavar="REGEX")] = ""
    """Only clips of the reference whose path below its folder holds this regular expression."""
    cuts: options.MaybeFile = None
    """Table (CSV) of the frames of the reference's files that are motion, as for train."""
    quiet: bool = False
    """No line on each clip and no progress bar."""
