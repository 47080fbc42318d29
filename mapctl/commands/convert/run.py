"""`mapctl convert`: any format to any format, other bones, another frame rate, and edits that everybody needs."""

from dataclasses import asdict

from mapctl import __version__, formats, report
from mapctl.commands.convert import Convert, folder
from mapctl.commands.convert.steps import Conversion, Converted
from mapctl.commands.shared import options, outputs
from mapctl.errors import RequestError


def run(command: Convert) -> int:
    """Read, convert, write: one file, or every one below a folder."""
    if command.rig is None and (command.report is not None or command.ground != "fit"):
        option = "--report" if command.report is not None else "--ground"
        raise RequestError(f"{option} is about motion on another rig; name one by --rig")
    if command.source.is_dir():
        return folder.run(command)
    for name, idle in (("to", command.to is None), ("again", not command.again), ("jobs", command.jobs == 1)):
        if not idle:
            raise RequestError(f"--{name} is for folders; {command.source} is a file")
    formats.check_ending(command.out)
    outputs.check_files([command.out, *options.collect_paths(command.report)])
    done = Conversion.of(command).convert(command.source)
    motion = done.motion
    formats.save(motion, command.out)
    _write_report(command, done)
    if not command.quiet:
        rate = f"{float(motion.fps):.6g} frames a second"
        print(
            "\n".join([f"{command.out}: {motion.num_frames} frames, {motion.num_joints} joints, {rate}", *done.lines])
        )
    return 0


def _write_report(command: Convert, done: Converted) -> None:
    """Write what was changed on the way to the rig, if a report is requested."""
    if command.report is None or done.changes is None:
        return
    request = options.describe_request("convert", command)
    changes = asdict(done.changes) | {"notes": list(done.notes)}
    report.write_report({"mapctl": __version__, "request": request, "changes": changes}, command.report)
