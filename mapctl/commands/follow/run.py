"""`mapctl follow`: a character walks a drawn curve.

What only some walks need, as films, is imported when one is asked for: it would double the time to the first step.
"""

from pathlib import Path
from typing import TYPE_CHECKING

import priors
from mapctl import formats, report
from mapctl.commands.follow import FollowCurve
from mapctl.commands.shared import inputs, licensing, options, outputs
from mapctl.commands.shared.character import read_character
from mapctl.commands.shared.exit_status import conclude
from mapctl.commands.shared.path_walk import Walk, parse_follow, walk
from mapctl.commands.shared.progress_bar import show_progress
from mapctl.errors import RequestError
from mapctl.intent.cornering import turns_sharply

if TYPE_CHECKING:
    from mapctl.commands.shared.shots.play import PlayedShot

_SIZE = (1280, 720)


def run(command: FollowCurve) -> int:
    """Check everything, solve, write, report. Ctrl-C ends the solve; the motion so far is written, without a film."""
    _check(command)
    with priors.use_weights(_find_weights(command)):
        return _follow(command)


def _find_weights(command: FollowCurve) -> str | None:
    """Find the set of weights: of the option, else of the file of keys."""
    if command.weights is not None or command.keys is None:
        return command.weights
    from mapctl.intent.shot_keys import read_shot_weights

    return read_shot_weights(command.keys)


def _follow(command: FollowCurve) -> int:
    curve = inputs.read_curve(command.curve, command.metres_per_unit)
    request = parse_follow(curve, command.speed, command.seconds)
    character, prior = read_character(command.rig, command), priors.load(command.prior)
    cornering = command.speed is None and turns_sharply(curve)
    if cornering or _wishes_more(command):
        from mapctl.commands.follow import shot
        from mapctl.commands.shared.shots.play import play_shot

        planned = shot.plan(command, curve, prior, character)
        with show_progress("walking", quiet=command.quiet) as progress:
            done = play_shot(planned, [], priors.load_inbetweener(), progress=progress)
    else:
        with show_progress("walking", quiet=command.quiet) as progress:
            done = walk(prior, request, seed=command.seed, progress=progress, character=character)
    video = None if done.interrupted else command.video
    _write(command, done, video)
    if not command.quiet:
        files = ", ".join(map(str, options.collect_paths(command.out, video, command.report)))
        print("\n".join([*done.summary(), f"wrote     {files}"]))
    return conclude(done.solution.status, strict=command.strict)


def _wishes_more(command: FollowCurve) -> bool:
    """Return whether more is wished than to walk along a curve."""
    told = command.keys is not None or command.gait or command.style or command.fps is not None
    return bool(told or command.avoid or command.start != "walk" or command.end != "walk" or command.loop)


def _check(command: FollowCurve) -> None:
    options.check_seed(command.seed)
    if command.fps is not None and not 1 <= command.fps <= 1000:
        raise RequestError(f"--fps must be 1 to 1000, got {command.fps:g}")
    formats.check_ending(command.out)
    outputs.check_files(options.collect_paths(command.out, command.video, command.report))
    if command.video is not None:
        outputs.check_film(command.video, _SIZE)


def _write(command: FollowCurve, done: "Walk | PlayedShot", video: Path | None) -> None:
    licensing.save_motion(done.on_rig, command.out)
    if command.report is not None:
        report.write_report(done.report(options.describe_request("follow", command)), command.report)
    if video is not None:
        _film(command, done, video)


def _film(command: FollowCurve, done: "Walk | PlayedShot", video: Path) -> None:
    from mapctl.commands.shared.shots.stage import build_obstacles, stage_actor
    from scenes.film import film

    with show_progress("filming", quiet=command.quiet) as progress:
        film([stage_actor(done)], video, size=_SIZE, props=build_obstacles([done]), progress=progress)
