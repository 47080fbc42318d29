"""`mapctl render`: a film of a motion."""

from dataclasses import dataclass
from typing import Annotated, ClassVar

from tyro.conf import arg

from mapctl.commands.shared import options
from mapctl.commands.shared.command import Command


@dataclass(frozen=True)
class Render(Command, options.RigOptions):
    """Film a motion: MP4, GIF, or a PNG contact sheet. Files of known rigs that have Z up are put upright."""

    single_thread: ClassVar[bool] = False

    source: options.InFile
    """.bvh, .npz, .recording, .amc with its .asf beside it, or a character's file (see `mapctl convert --help`)."""
    out: options.OutFile
    """.mp4, .gif, .webp or .png."""
    curve: options.MaybeCurve = None
    """Curve drawn on the ground: circle:4, a CSV, an SVG (see `mapctl follow --help`)."""
    character: options.MaybeCharacter = None
    """File of a skinned character, as .glb or .vrm, that is drawn in place of the mannequin: with its own mesh, moved
    as `mapctl convert --rig` moves it. A motion that is read from that file needs no conversion."""
    camera: Annotated[options.CameraKind, arg(metavar="follow|fixed|top")] = "follow"
    """Camera that follows, is fixed with all in view, or looks from above."""
    size: options.Size = "1280x720"
    """Width and height in pixels."""
    metres_per_unit: options.MaybeNumber = None
    """Scale of a CSV or SVG file."""
    quiet: bool = False
    """No line on what was written and no progress bar."""
