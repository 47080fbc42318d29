"""`mapctl convert`: any format to any format, other bones, another frame rate, and edits that everybody needs."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, ClassVar, Literal

from tyro.conf import Positional, arg

from mapctl.commands.shared import options
from mapctl.commands.shared.command import Command


@dataclass(frozen=True)
class Convert(Command, options.ReadOptions):
    """Write a motion, or a folder of them, in another format, on another skeleton or at another frame rate, or some
    frames of it; mirrored, with planted feet, as a loop, in place, or with its travel on the root joint.

    What is asked for is done in this order: frames, rig, frame rate, mirror, loop, feet, travel.
    """

    single_thread: ClassVar[bool] = False

    source: Positional[Annotated[Path, arg(metavar="IN|FOLDER")]]
    """.bvh, .npz, .recording, or .amc: its skeleton is the .asf of the same name, else the only one in the folder, else
    named as in subject.asf+take.amc. Of a character (.glb, .gltf, .vrm, .vrma, .usda, .usdc, .usd, .usdz, .fbx) its
    first animation, else one frame of its rest pose; hero.glb#ARMATURE, hero.glb#ARMATURE/ANIMATION and
    hero.glb#/ANIMATION choose others. Or a folder, every motion below it."""
    out: Positional[Annotated[Path, arg(metavar="OUT|FOLDER")]]
    """.bvh, .npz, or with a skinned body .glb, .usda, .usdc or .usd: that of the character in IN or in --rig, where it
    came from such a file, else a mannequin. A .vrm is written of a VRM character only. A .vrma holds motion
    alone: of the bones of a VRM, or of any rig's canonical joints. Of a folder another one, which gets the same
    names."""
    to: Annotated[str | None, arg(metavar=".ENDING")] = None
    """For a folder: the ending of all results, as .glb; their own if not given, or .bvh."""
    rig: Annotated[str | None, arg(metavar="canonical|PRESET|FILE.toml|CLIP")] = None
    """`canonical`: canonical joints with the performer's own bones; or a clip whose skeleton is wanted, on which the
    character has its floor and planted feet, in the clip's layout; or a rig by name or TOML file, whose joints
    get the bones of the canonical body."""
    ground: Literal["fit", "keep"] = "fit"
    """Of what feet stand on, as stairs and platforms, on the skeleton of another rig: `fit` scales its height with the
    legs, `keep` keeps it in metres."""
    report: options.MaybeFile = None
    """Where to write what was changed on the way to the rig, as JSON: scale, travel, hips, feet and hands that do not
    get where they should."""
    source_rig: options.MaybeRig = None
    """The rig of IN, where it is not the one that would be recognised; see `mapctl info IN`."""
    frames: Annotated[str | None, arg(metavar="A:B")] = None
    """Only these frames of IN, or seconds as in 2s:4s; B is the first that is left out."""
    fps: Annotated[str | None, arg(metavar="F")] = None
    """Frames per second, as 30, 29.97 or 30000/1001: positions linear, rotations by slerp."""
    fps_in: Annotated[str | None, arg(metavar="F")] = None
    """Frames per second of an .amc, which are not in the file; 120 unless given."""
    mirror: bool = False
    """Exchange left and right, on the same bones, through the plane x = 0."""
    loop: bool = False
    """Cut to the cycle of the motion, of a walk or a run one stride, and close it, to be played again and again."""
    plant_feet: bool = False
    """Hold planted toes still and on the floor by the legs; nothing else changes but for hips that must go down."""
    in_place: bool = False
    """Take out the travel over the ground: sway, bounce and heading stay."""
    root_motion: bool = False
    """Put the travel, position on the ground and heading, on the root joint above the hips; one is added where the rig
    has none."""
    jobs: options.Count = 1
    """For a folder: number of files at once, each in a process of its own."""
    again: bool = False
    """For a folder: convert files again whose result exists already."""
    quiet: bool = False
    """No summary and no progress bar."""
