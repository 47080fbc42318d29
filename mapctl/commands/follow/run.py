"""`mapctl follow`: a character walks a drawn curve."""

from fractions import Fraction
from pathlib import Path

import priors
from controllers.common.character import Character
from mapctl import formats, report
from mapctl.commands.follow import FollowCurve
from mapctl.commands.shared import inputs, options, outputs, results
from mapctl.commands.shared.character import read_character, read_drawn_character
from mapctl.commands.shared.path_walk import Walk, parse_follow, walk
from mapctl.commands.shared.progress_bar import show_progress
from mapctl.commands.shared.shots.plan import ShotPlan, plan_shot
from mapctl.commands.shared.shots.play import PlayedShot, play_shot
from mapctl.commands.shared.shots.stage import build_obstacles, print_notes, stage_actor
from mapctl.curves import Curve
from mapctl.curves.obstacles import Obstacle
from mapctl.errors import RequestError
from mapctl.intent.cornering import turns_sharply
from mapctl.intent.shot_keys import read_shot_keys
from priors.lstm_gmm.density import LstmGmmDensity
from scenes.cameras import CameraSettings
from scenes.drawn_character import DrawnCharacter
from scenes.film import film
from scenes.scene_file import Actor

_SIZE = "1280x720"


def run(command: FollowCurve) -> int:
    """Check everything, solve, write, report. Ctrl-C ends the solve; the motion so far is written, without a film."""
    _check(command)
    curve = inputs.read_curve(command.curve, command.metres_per_unit)
    request = parse_follow(curve, command.speed, command.seconds)
    drawn = read_drawn_character(command.character)
    character, prior = read_character(command.rig), priors.load(command.prior)
    cornering = command.speed is None and turns_sharply(curve)
    plan = _plan(command, curve, prior, character) if cornering or _wishes_more(command) else None
    with show_progress("walking", quiet=command.quiet) as progress:
        if plan is not None:
            done = play_shot(plan, [], priors.load_inbetweener(), prices=command.prices, progress=progress)
        else:
            done = walk(prior, request, seed=command.seed, progress=progress, character=character)
    video = None if done.interrupted else command.video
    _write(command, done, video, drawn)
    if not command.quiet:
        files = ", ".join(map(str, options.collect_paths(command.out, video, command.report)))
        print("\n".join([*done.summary(), f"wrote     {files}"]))
    return results.conclude(done.solution.status, strict=command.strict)


def _wishes_more(command: FollowCurve) -> bool:
    """Return whether more is wished than to walk along a curve."""
    told = command.keys is not None or command.gait or command.style or command.fps is not None
    return bool(
        told or command.avoid or command.start != "walk" or command.end != "walk" or command.loop or command.prices
    )


def _plan(command: FollowCurve, curve: Curve, prior: LstmGmmDensity, character: Character) -> ShotPlan:
    """Plan the shot that the options describe; files are relative to the working directory."""
    actor = Actor(
        curve=command.curve,
        speed=command.speed,
        seconds=command.seconds,
        seed=command.seed,
        gait=command.gait,
        style=command.style,
        start=command.start,
        end=command.end,
        loop=command.loop,
        keys=() if command.keys is None else read_shot_keys(command.keys),
    )
    if actor.fault is not None:
        raise RequestError(f"--{actor.fault}")
    obstacles = [Obstacle.parse(text) for text in command.avoid]
    fps = None if command.fps is None else Fraction(command.fps).limit_denominator(100_000)
    return plan_shot(actor, curve, prior, character=character, folder=Path(), obstacles=obstacles, fps=fps)


def _check(command: FollowCurve) -> None:
    options.check_seed(command.seed)
    if command.fps is not None and not 1 <= command.fps <= 1000:
        raise RequestError(f"--fps must be 1 to 1000, got {command.fps:g}")
    formats.check_ending(command.out)
    outputs.check_files(options.collect_paths(command.out, command.video, command.report))
    for name in ("camera", "size", "character"):
        if command.video is None and getattr(command, name) is not None:
            raise RequestError(f"--{name} is of the film, and --video asks for none")
    if command.video is not None:
        outputs.check_film(command.video, options.parse_size(command.size or _SIZE))


def _write(command: FollowCurve, done: Walk | PlayedShot, video: Path | None, character: DrawnCharacter | None) -> None:
    done.on_rig.save(command.out)
    if command.report is not None:
        report.write_report(done.report(options.describe_request("follow", command)), command.report)
    if video is not None:
        actors, camera = [stage_actor(done, character=character)], CameraSettings(command.camera or "follow")
        with show_progress("filming", quiet=command.quiet) as progress:
            size = options.parse_size(command.size or _SIZE)
            film(actors, video, camera=camera, size=size, props=build_obstacles([done]), progress=progress)
        if not command.quiet:
            print_notes(actors)
