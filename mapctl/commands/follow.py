"""`mapctl follow`: a character walks a drawn curve."""

from dataclasses import dataclass, fields, replace
from fractions import Fraction
from pathlib import Path

from tyro.conf import Positional

import priors
from mapctl import curves, formats
from mapctl.commands.shared import inputs, options, outputs
from mapctl.commands.shared.command import ModelCommand, conclude
from mapctl.commands.shared.shots import build_obstacles, plan_shot, play_shot, stage_actor
from mapctl.curves.obstacles import Obstacle
from mapctl.errors import RequestError
from mapctl.ground import Ground
from mapctl.intent.shot_keys import ShotKeyFile
from mapctl.report import write_report
from scenes.film import film
from scenes.scene_file import Actor, ShotOptions


@dataclass(frozen=True, kw_only=True)
class FollowCurve(ModelCommand, options.ReadOptions, ShotOptions):
    """A character walks a curve: BVH and, if requested, a film and a report."""

    curve: Positional[options.CurveText]
    """circle:4, figure8:2, s:6, line:10, wave:1x8 (metres), a CSV file of x,z or, with heights of the hips,
    x,y,z, or an SVG file; drawing.svg#walk or drawing.svg#2 is one of its paths, by id, label or number from 1."""
    out: options.OutFile
    """Output file: .bvh, .npz, .glb or .usda."""
    speed: options.MaybeSpeed = None
    """Speed along the curve: a number, or 0:1.0,5:2.5 for 1 m/s at the start rising to 2.5 m/s at 5 m; 1.2 if it is not
    given, and less in corners that turn faster than walking people do."""
    prior: options.Prior = "locomotion"
    rig: options.BodyRig = "canonical"
    keys: options.MaybeFile = None
    """TOML file of [[key]] tables: what hands and feet reach for, the head looks at, which pose is held, and when."""
    avoid: options.Avoid = ()
    ground: options.MaybeFile = None
    """TOML file of the ground, where it is not flat: boxes, ramps, stairs or a grey picture as a height field."""
    variations: options.Count = 1
    """Number of takes, each with the next seed; their files are OUT_000, OUT_001, ..."""
    fps: options.MaybeNumber = None
    """Frame rate of the motion; 30, or that of the clip it continues from, if not given."""
    video: options.MaybeFile = None
    """Film of the walk: .mp4, .gif, .webp or .png (contact sheet)."""
    report: options.MaybeFile = None
    """JSON with the request, status, ledger, measures and timing."""
    metres_per_unit: options.MaybeNumber = None
    """Scale of a CSV or SVG file; 1 for a CSV and 0.01 for an SVG if not given."""
    strict: bool = False
    """Exit with status 3 where not all that was requested holds."""
    quiet: options.Quiet = False


def run(command: FollowCurve) -> int:
    """Check everything, solve, write, report. Ctrl-C ends the solve; the motion so far is written, without a film."""
    options.check_seed(command.seed)
    options.check_liveliness(command.liveliness)
    if command.fps is not None and not 1 <= command.fps <= 1000:
        raise RequestError(f"--fps must be 1 to 1000, got {command.fps:g}")
    options.check_variations(command.variations)
    formats.check_ending(command.out)
    takes = [command] if command.variations == 1 else [_number(command, take) for take in range(command.variations)]
    outputs.check_files([path for take in takes for path in options.collect_paths(take.out, take.video, take.report)])
    if command.video is not None:
        outputs.check_film(command.video, outputs.FILM_SIZE)
    file = None if command.keys is None else ShotKeyFile.read(command.keys)
    with priors.use_weights(command.weights or (file and file.weights)):
        return max(_follow(take, file) for take in takes)


def _number(command: FollowCurve, take: int) -> FollowCurve:
    paths = {"out": command.out, "video": command.video, "report": command.report}
    numbered = {name: None if path is None else outputs.number_path(path, take) for name, path in paths.items()}
    return replace(command, seed=command.seed + take, **numbered)


def _follow(command: FollowCurve, file: ShotKeyFile | None) -> int:
    shared = {item.name: getattr(command, item.name) for item in fields(ShotOptions)}
    actor = Actor(**shared, curve=command.curve, keys=() if file is None else file.key)
    if actor.fault is not None:
        raise RequestError(f"--{actor.fault}")
    plan = plan_shot(
        actor,
        curves.read(command.curve, metres_per_unit=command.metres_per_unit),
        priors.load(command.prior),
        character=inputs.read_character(command.rig, command),
        folder=Path(),
        options=command,
        obstacles=[Obstacle.parse(text) for text in command.avoid],
        ground=None if command.ground is None else Ground.read(command.ground),
        fps=None if command.fps is None else Fraction(command.fps).limit_denominator(100_000),
    )
    with outputs.show_progress("walking", quiet=command.quiet) as progress:
        done = play_shot(plan, progress=progress)
    outputs.save_motion(done.on_rig, command.out)
    if command.report is not None:
        write_report(done.report(options.describe_request("follow", command)), command.report)
    video = None if done.interrupted else command.video
    if video is not None:
        with outputs.show_progress("filming", quiet=command.quiet) as progress:
            film(
                [stage_actor(done)],
                video,
                size=outputs.FILM_SIZE,
                props=build_obstacles([done]),
                ground=plan.request.ground,
                progress=progress,
            )
    if not command.quiet:
        files = ", ".join(map(str, options.collect_paths(command.out, video, command.report)))
        print("\n".join([*done.summary(), f"wrote     {files}"]))
    return conclude(done.solution.status, strict=command.strict)
