"""`mapctl follow`: a character walks a drawn curve."""

from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, UseAppendAction, arg

import priors
from controllers.common.character import Character
from mapctl import formats, report
from mapctl.commands.shared import inputs, options, outputs
from mapctl.commands.shared.command import ModelCommand, conclude
from mapctl.commands.shared.inputs import read_character
from mapctl.commands.shared.outputs import show_progress
from mapctl.commands.shared.shots import PlayedShot, ShotPlan, build_obstacles, plan_shot, play_shot, stage_actor
from mapctl.curves import Curve
from mapctl.curves.obstacles import Obstacle
from mapctl.errors import RequestError
from mapctl.intent.shot_keys import read_shot_keys, read_shot_weights
from priors.lstm_gmm.density import LstmGmmDensity
from scenes.film import film
from scenes.scene_file import Actor


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
    return read_shot_weights(command.keys)


def _follow(command: FollowCurve) -> int:
    curve = inputs.read_curve(command.curve, command.metres_per_unit)
    character, prior = read_character(command.rig, command), priors.load(command.prior)
    plan = plan_walk(command, curve, prior, character)
    with show_progress("walking", quiet=command.quiet) as progress:
        done = play_shot(plan, progress=progress)
    video = None if done.interrupted else command.video
    _write(command, done, video)
    if not command.quiet:
        files = ", ".join(map(str, options.collect_paths(command.out, video, command.report)))
        print("\n".join([*done.summary(), f"wrote     {files}"]))
    return conclude(done.solution.status, strict=command.strict)


def _check(command: FollowCurve) -> None:
    options.check_seed(command.seed)
    if command.fps is not None and not 1 <= command.fps <= 1000:
        raise RequestError(f"--fps must be 1 to 1000, got {command.fps:g}")
    formats.check_ending(command.out)
    outputs.check_files(options.collect_paths(command.out, command.video, command.report))
    if command.video is not None:
        outputs.check_film(command.video, _SIZE)


def _write(command: FollowCurve, done: PlayedShot, video: Path | None) -> None:
    outputs.save_motion(done.on_rig, command.out)
    if command.report is not None:
        report.write_report(done.report(options.describe_request("follow", command)), command.report)
    if video is not None:
        _film(command, done, video)


def _film(command: FollowCurve, done: PlayedShot, video: Path) -> None:
    with show_progress("filming", quiet=command.quiet) as progress:
        film([stage_actor(done)], video, size=_SIZE, props=build_obstacles([done]), progress=progress)


def plan_walk(command: FollowCurve, curve: Curve, prior: LstmGmmDensity, character: Character) -> ShotPlan:
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
    return plan_shot(
        actor, curve, prior, character=character, folder=Path(), options=command, obstacles=obstacles, fps=fps
    )
