"""`mapctl convert`: any format to any format, other bones, another frame rate."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, ClassVar

from tyro.conf import Positional, arg

from mapctl.commands.shared import options
from mapctl.commands.shared.command import Command


@dataclass(frozen=True)
class Convert(Command):
    """Write a motion in another format, on another skeleton or at another frame rate, or some frames of it."""

    single_thread: ClassVar[bool] = False

    source: options.InFile
    """.bvh, .npz, or .amc: its skeleton is the .asf of the same name, else the only one in the folder, else
    named as in subject.asf+take.amc. Of a character (.glb, .gltf, .vrm) its first animation, else one frame of its
    rest pose; hero.glb#ARMATURE, hero.glb#ARMATURE/ANIMATION and hero.glb#/ANIMATION choose others."""
    out: Positional[Annotated[Path, arg(metavar="OUT")]]
    """.bvh, .npz, or with a skinned body .glb, .usda, .usdc or .usd: that of the character in IN or in --rig, where it
    came from such a file, else a mannequin. A .vrm is written of a VRM character only."""
    rig: Annotated[str | None, arg(metavar="canonical|PRESET|FILE.toml|CLIP")] = None
    """`canonical`: canonical joints with the performer's own bones; or a clip whose skeleton is wanted, on which the
    character has its floor and planted feet, in the clip's layout; or a rig by name or TOML file, whose joints
    get the bones of the canonical body."""
    source_rig: options.MaybeRig = None
    """The rig of IN, where it is not the one that would be recognised; see `mapctl info IN`."""
    frames: Annotated[str | None, arg(metavar="A:B")] = None
    """Only these frames of IN, or seconds as in 2s:4s; B is the first that is left out."""
    fps: Annotated[str | None, arg(metavar="F")] = None
    """Frames per second, as 30, 29.97 or 30000/1001: positions linear, rotations by slerp."""
    fps_in: Annotated[str | None, arg(metavar="F")] = None
    """Frames per second of an .amc, which are not in the file; 120 unless given."""
