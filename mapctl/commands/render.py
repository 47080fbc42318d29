"""`mapctl render`: a film of a motion."""

from dataclasses import dataclass
from typing import Annotated

from tyro.conf import arg

from mapctl.commands.shared import options, outputs
from mapctl.runtime.progress import show_progress


@dataclass(frozen=True)
class Render:
    """Film a motion: MP4, GIF, or a PNG contact sheet. Files of known rigs that have Z up are put upright."""

    source: options.InFile
    """.bvh, .npz, or .amc with its .asf beside it."""
    out: options.OutFile
    """.mp4, .gif or .png."""
    curve: options.MaybeCurve = None
    """Drawn on the ground: circle:4, a CSV, an SVG (see `mapctl follow --help`)."""
    camera: Annotated[options.CameraKind, arg(metavar="follow|fixed|top")] = "follow"
    """Goes along, stands so that all is seen, or looks from above."""
    size: options.Size = "1280x720"
    """Width and height in pixels."""
    metres_per_unit: options.MaybeNumber = None
    """Scale of a CSV or SVG file."""
    quiet: bool = False
    """No line on what was written and no progress bar."""

    def run(self) -> int:
        """Check, film, tell."""
        size = options.parse_size(self.size)
        outputs.check_film(self.out, size)
        curve = None if self.curve is None else options.read_curve(self.curve, self.metres_per_unit)
        from mapctl import formats
        from mapctl.retarget.upright import put_upright
        from scenes.cameras import CameraSettings
        from scenes.film import film

        motion, notes = put_upright(formats.load(self.source))
        with show_progress("filming", quiet=self.quiet) as progress:
            camera = CameraSettings(self.camera)
            film([(motion, curve)], self.out, camera=camera, size=size, progress=progress)
        if not self.quiet:
            print("\n".join((f"{self.out}: {motion.seconds:.1f} s of {size[0]}x{size[1]}", *notes)))
        return 0
