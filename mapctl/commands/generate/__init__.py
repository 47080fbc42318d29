"""`mapctl generate`: motion drawn from a prior, of any length."""

from dataclasses import dataclass
from typing import Annotated

from tyro.conf import arg

from mapctl.commands.shared import options
from mapctl.commands.shared.command import Command


@dataclass(frozen=True)
class Generate(Command):
    """Motion drawn from a prior, of any length: OUT/generated_000.bvh, generated_001.bvh, ..."""

    out: options.OutFolder
    """Folder for the clips; made if it is not there."""
    seconds: options.Number
    """Length of each clip."""
    count: options.Count = 1
    """How many clips."""
    seed: options.Count = 0
    """Of everything random; each clip draws its own seed from it. Their starts are spread over the data's speeds."""
    temperature: options.Number = 1.0
    """Spread of the draws, 0 to 2: 0 is the prior's mean, 1 the prior itself."""
    start: Annotated[str | None, arg(metavar="CLIP|INDEX")] = None
    """A clip (.bvh, .npz, .amc) to go on from, or the number of a start of the prior for all; drawn if not given."""
    prior: options.Name = "locomotion"
    """A bundled prior, or the file or run folder of a trained one."""
    style: Annotated[str | None, arg(metavar="NAME,NAME")] = None
    """Gait and style by the names of the prior's data, such as run or elderly,walk; `none` leaves the prior to itself.
    If not given, motion goes on as the clip does that it begins from."""
    refiner: options.Name = "auto"
    """A bundled refiner, or the file or run folder of a trained one, to go before the footing pass. auto: the prior's
    own where there is no footing pass, and none before one, which measures better alone."""
    no_footing: bool = False
    """Leave out the pass that makes planted feet stand: many times faster, with the refiner's feet."""
    no_refine: bool = False
    """Leave the draws as they are: no refiner, and no pass that makes planted feet stand."""
    rig: options.OutRig = "canonical"
    """Whose body moves: the canonical one, or that of a clip, on whose rig the motion is then written; or a rig by name
    or TOML file, whose joints get the canonical bones."""
    quiet: bool = False
    """No lines on the clips and no progress bar."""
