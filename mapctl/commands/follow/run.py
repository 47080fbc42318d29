"""`mapctl follow`: a character walks a drawn curve."""

from pathlib import Path

import priors
from mapctl import formats, report
from mapctl.commands.follow import FollowCurve
from mapctl.commands.shared import inputs, options, outputs, results
from mapctl.commands.shared.character import read_character
from mapctl.commands.shared.path_walk import Walk, parse_follow, walk
from mapctl.commands.shared.progress_bar import show_progress
from mapctl.errors import RequestError
from scenes.cameras import CameraSettings
from scenes.film import film

_SIZE = "1280x720"


def run(command: FollowCurve) -> int:
    """Check everything, solve, write, report. Ctrl-C ends the solve; the motion so far is written, without a film."""
    _check(command)
    request = parse_follow(inputs.read_curve(command.curve, command.metres_per_unit), command.speed, command.seconds)
    character, prior = read_character(command.rig), priors.load(command.prior)
    with show_progress("walking", quiet=command.quiet) as progress:
        done = walk(prior, request, seed=command.seed, progress=progress, character=character)
    video = None if done.interrupted else command.video
    _write(command, done, video)
    if not command.quiet:
        files = ", ".join(map(str, options.collect_paths(command.out, video, command.report)))
        print("\n".join([*done.summary(), f"wrote     {files}"]))
    return results.conclude(done.solution.status, strict=command.strict)


def _check(command: FollowCurve) -> None:
    options.check_seed(command.seed)
    formats.check_ending(command.out)
    outputs.check_files(options.collect_paths(command.out, command.video, command.report))
    for name in ("camera", "size"):
        if command.video is None and getattr(command, name) is not None:
            raise RequestError(f"--{name} is of the film, and --video asks for none")
    if command.video is not None:
        outputs.check_film(command.video, options.parse_size(command.size or _SIZE))


def _write(command: FollowCurve, done: Walk, video: Path | None) -> None:
    done.on_rig.save(command.out)
    if command.report is not None:
        report.write_report(done.report(options.describe_request("follow", command)), command.report)
    if video is not None:
        actors, camera = [(done.solution.motion, done.request.curve)], CameraSettings(command.camera or "follow")
        with show_progress("filming", quiet=command.quiet) as progress:
            size = options.parse_size(command.size or _SIZE)
            film(actors, video, camera=camera, size=size, progress=progress)
