"""`mapctl render`: a film of a motion."""

from dataclasses import dataclass
from typing import Annotated

from tyro.conf import arg

from mapctl import curves
from mapctl.commands.shared import inputs, options, outputs
from mapctl.commands.shared.command import Command
from mapctl.curves import Curve
from mapctl.ground import Ground
from mapctl.motion import Motion
from mapctl.retarget import put_upright
from mapctl.retarget.rigs import Rig
from scenes.cameras import CameraSettings
from scenes.drawn_character import DrawnCharacter
from scenes.film import film
from scenes.stage import Shot


@dataclass(frozen=True)
class Render(Command, options.RigOptions):
    """Film a motion: MP4, GIF, or a PNG contact sheet. Files of known rigs that have Z up are put upright."""

    source: options.InFile
    """.bvh, .npz, .amc with its .asf beside it, or a character's file (see `mapctl convert --help`)."""
    out: options.OutFile
    """.mp4, .gif, .webp or .png."""
    curve: options.MaybeCurve = None
    """Curve drawn on the ground: circle:4, a CSV, an SVG (see `mapctl follow --help`)."""
    character: options.MaybeCharacter = None
    """File of a skinned character, as .glb or .vrm, that is drawn in place of the mannequin: with its own mesh, moved
    as `mapctl convert --rig` moves it. A motion that is read from that file needs no conversion."""
    ground: options.MaybeFile = None
    """TOML file of the ground, where it is not flat (see `mapctl follow --help`)."""
    camera: Annotated[options.CameraKind, arg(metavar="follow|fixed|top")] = "follow"
    """Camera that follows, is fixed with all in view, or looks from above."""
    size: options.Size = "1280x720"
    """Width and height in pixels."""
    metres_per_unit: options.MaybeNumber = None
    """Scale of a CSV or SVG file."""
    quiet: options.Quiet = False


def run(command: Render) -> int:
    size = options.parse_size(command.size)
    outputs.check_film(command.out, size)
    curve = None if command.curve is None else curves.read(command.curve, metres_per_unit=command.metres_per_unit)
    ground = None if command.ground is None else Ground.read(command.ground)
    rig = inputs.read_rig(command.rig, command)
    motion = inputs.read_motion(command.source, rig, quiet=command.quiet)
    shot, notes = _prepare_shot(motion, rig, curve, command.character)
    with outputs.show_progress("filming", quiet=command.quiet) as progress:
        camera = CameraSettings(command.camera)
        film([shot], command.out, camera=camera, size=size, ground=ground, progress=progress)
    if not command.quiet:
        print("\n".join((f"{command.out}: {shot.motion.seconds:.1f} s of {size[0]}x{size[1]}", *notes)))
    return 0


def _prepare_shot(
    motion: Motion, rig: Rig | None, curve: Curve | None, character: str | None
) -> tuple[Shot, tuple[str, ...]]:
    """Put the motion upright, or on a character; also return notes on what is not known or not kept."""
    upright, notes = put_upright(motion, rig)
    if character is None:
        return Shot(upright, curve), notes
    drawn = DrawnCharacter.load(character).put_on(motion if rig is None else upright)
    return Shot(motion, curve, drawn=drawn), drawn.notes
