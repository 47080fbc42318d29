"""`mapctl render`: a film of a motion."""

from mapctl import formats
from mapctl.commands.render import Render
from mapctl.commands.shared import inputs, options, outputs
from mapctl.commands.shared.progress_bar import show_progress
from mapctl.retarget.upright import put_upright
from scenes.cameras import CameraSettings
from scenes.film import film


def run(command: Render) -> int:
    """Check, film, report."""
    size = options.parse_size(command.size)
    outputs.check_film(command.out, size)
    curve = None if command.curve is None else inputs.read_curve(command.curve, command.metres_per_unit)
    motion, notes = put_upright(formats.load(command.source))
    with show_progress("filming", quiet=command.quiet) as progress:
        camera = CameraSettings(command.camera)
        film([(motion, curve)], command.out, camera=camera, size=size, progress=progress)
    if not command.quiet:
        print("\n".join((f"{command.out}: {motion.seconds:.1f} s of {size[0]}x{size[1]}", *notes)))
    return 0
