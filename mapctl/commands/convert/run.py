"""`mapctl convert`: any format to any format, other bones, another frame rate, and edits that everybody needs."""

from mapctl import formats
from mapctl.commands.convert import Convert, folder
from mapctl.commands.convert.steps import Conversion
from mapctl.commands.shared import outputs
from mapctl.errors import RequestError


def run(command: Convert) -> int:
    """Read, convert, write: one file, or every one below a folder."""
    if command.source.is_dir():
        return folder.run(command)
    for name, idle in (("to", command.to is None), ("again", not command.again), ("jobs", command.jobs == 1)):
        if not idle:
            raise RequestError(f"--{name} is for folders; {command.source} is a file")
    formats.check_ending(command.out)
    outputs.check_files([command.out])
    done = Conversion.of(command).convert(command.source)
    motion = done.motion
    formats.save(motion, command.out)
    if not command.quiet:
        rate = f"{float(motion.fps):.6g} frames a second"
        print(
            "\n".join([f"{command.out}: {motion.num_frames} frames, {motion.num_joints} joints, {rate}", *done.lines])
        )
    return 0
