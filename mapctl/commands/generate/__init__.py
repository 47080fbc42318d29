"""`mapctl generate`: motion sampled from a prior, of any length."""

from dataclasses import dataclass
from typing import Annotated

from tyro.conf import arg

from mapctl.commands.shared import options
from mapctl.commands.shared.command import ModelCommand


@dataclass(frozen=True)
class Generate(ModelCommand, options.ReadOptions):
    """Motion sampled from a prior, of any length: OUT/generated_000.bvh, generated_001.bvh, ..."""

    out: options.OutFolder
    """Folder for the clips; made if it does not exist."""
    seconds: options.Number
    """Length of each clip."""
    count: options.Count = 1
    """Number of clips."""
    seed: options.Count = 0
    """Seed of everything random; each clip gets its own seed from it. Initial states are stratified over the data's
    speeds."""
    temperature: options.Number = 1.0
    """Temperature of the samples, 0 to 2: 0 is the prior's mean, 1 the prior itself."""
    start: Annotated[str | None, arg(metavar="CLIP|INDEX")] = None
    """A clip (.bvh, .npz, .amc) to go on from, or the index of an initial state for all; sampled if not given."""
    prior: options.Name = "locomotion"
    """A bundled prior, or the file or run folder of a trained one."""
    style: Annotated[str | None, arg(metavar="NAME,NAME")] = None
    """Gait, style and pace by the names of the prior's data, such as run or elderly,walk; `none` leaves the prior
    unconditioned. If not given, gait and style are those of the clip that it begins from. Unless a pace is named, a
    prior that knows paces is told one after the other."""
    refiner: options.MaybeName = None
    """A refiner between samples and foot clean-up: a bundled one, the file or run folder of a trained one, or auto, the
    prior's own. None if not given: refined samples are told from mocap more often."""
    no_footing: bool = False
    """Leave out the foot clean-up. Without a refiner, each frame is then sampled given that toes stand where its
    contact bits say so: feet slide about as mocap's do, and it is faster."""
    rig: options.OutRig = "canonical"
    """Body that moves: the canonical one, or that of a clip, on whose rig the motion is then written; or a rig by name
    or TOML file, whose joints get the canonical bones."""
    to: Annotated[str, arg(metavar=".bvh|.npz|.glb|...")] = ".bvh"
    """Format of the clips by its ending; a character of --rig is written with them where the ending is its own.
    Only .bvh is written as it is sampled, the others take memory for the whole clip."""
    quiet: bool = False
    """No lines on the clips and no progress bar."""
