"""`mapctl follow`: a character walks a drawn curve."""

from dataclasses import dataclass
from typing import Annotated

from tyro.conf import Positional, UseAppendAction, arg

from mapctl.commands.shared import options
from mapctl.commands.shared.command import ModelCommand


@dataclass(frozen=True)
class FollowCurve(ModelCommand, options.ReadOptions):
    """A character walks a curve: BVH and, if asked for, a film and a report."""

    curve: Positional[options.CurveText]
    """circle:4, figure8:2, s:6, line:10, wave:1x8 (metres), a CSV file of x,z or x,y,z, or an SVG file."""
    out: options.OutFile
    """Where the motion goes: .bvh, .npz, .glb or .usda."""
    speed: options.MaybeSpeed = None
    """Speed along the curve: a number, or 0:1.0,5:2.5 for 1 m/s at the start rising to 2.5 m/s at 5 m; 1.2 if it is not
    given, and less in corners that turn faster than people who walk do."""
    seconds: options.MaybeNumber = None
    """Duration of the walk; once along the curve if not given."""
    prior: options.Name = "locomotion"
    """A bundled prior, or the file or run folder of a trained one."""
    seed: options.Count = 0
    """Seed of everything random: the same seed gives the same file."""
    rig: options.OutRig = "canonical"
    """Body that moves: the canonical one, or that of a clip, on whose rig the motion is then written; or a rig by name
    or TOML file, whose joints get the canonical bones."""
    start: Annotated[str, arg(metavar="walk|stand|CLIP:FRAME")] = "walk"
    """How it begins: in its stride, standing, or going on from a frame of a motion file, on that file's rig and at its
    rate."""
    end: Annotated[str, arg(metavar="walk|stand|CLIP:FRAME")] = "walk"
    """How it ends: in its stride, standing, or in a frame of a motion file."""
    loop: bool = False
    """The last frame leads into the first: once around a closed curve."""
    keys: options.MaybeFile = None
    """TOML file of [[key]] tables: what hands and feet reach for, the head looks at, which pose is held, and when."""
    avoid: Annotated[UseAppendAction[tuple[str, ...]], arg(metavar="X,Z,RADIUS")] = ()
    """A disc on the ground to walk around, metres; may be given several times."""
    gait: options.MaybeName = None
    """Gait of the motion, of those that the prior knows."""
    style: options.MaybeName = None
    """Style of the motion, of those that the prior knows."""
    fps: options.MaybeNumber = None
    """Frame rate of the motion; 30, or that of the clip it goes on from, if not given."""
    video: options.MaybeFile = None
    """Film of the walk: .mp4, .gif, .webp or .png (contact sheet)."""
    report: options.MaybeFile = None
    """JSON with the request, status, ledger, measures and timing."""
    metres_per_unit: options.MaybeNumber = None
    """Scale of a CSV or SVG file; 1 for a CSV and 0.01 for an SVG if not given."""
    strict: bool = False
    """Exit with status 3 where not all that was requested holds."""
    quiet: bool = False
    """No summary and no progress bar."""
