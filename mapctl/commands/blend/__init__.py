"""`mapctl blend`: a hand or foot of one clip does for a while what it does in another."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import arg

from mapctl.commands.shared import options
from mapctl.commands.shared.command import Command


@dataclass(frozen=True)
class Blend(Command):
    """Hands or feet of a clip do for a while what they do in another one: a walk that reaches or waves."""

    source: options.InFile
    """A motion file."""
    other: Annotated[Path, arg(name="from", metavar="CLIP")]
    """The clip that it is taken from, of any known rig; brought to IN's frame rate."""
    joints: Annotated[str, arg(metavar="NAME,NAME")]
    """Hands and feet, by the names of IN's rig or the canonical ones."""
    frames: Annotated[str, arg(metavar="A:B")]
    """Of the other clip, in its own frames whatever its rate, or seconds as in 2s:2.5s."""
    at: Annotated[str, arg(metavar="FRAME")]
    """Where they go in IN, or seconds as in 1.5s."""
    out: options.OutFile
    """Where the motion goes."""
    margin: options.MaybeNumber = None
    """Seconds before and after in which the limb goes there and back; as long as the distance asks for, if not
    given."""
    no_finish: bool = False
    """Leave the infiller's proposal as it is, on rigid bones: no MAP stage puts the feet down."""
    infiller: options.Name = "infiller"
    """The bundled infiller, or the file or run folder of a trained one."""
    rig: options.MaybeRig = None
    """The rig of IN, where it is not the one that would be recognised; see `mapctl info IN`."""
    video: options.MaybeFile = None
    """Film of the given motion and the new one side by side: .mp4, .gif or .png."""
    strict: bool = False
    """Exit with status 3 where not all that was asked holds: a limb that has to go far in little time."""
    quiet: bool = False
    """No summary and no progress bar."""
