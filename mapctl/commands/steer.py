"""`mapctl steer`: a script of commands is replayed, as live steering would answer it."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import torch
from tyro.conf import Positional, arg

import priors
from controllers.common.character import Character
from controllers.shots.uneven import step_onto_ground
from controllers.steering import steer
from controllers.steering.arrival import Arriver
from controllers.steering.loop import (
    Display,
    Recorder,
    Stepper,
    StepRecord,
    StreamClock,
    WallClock,
    drive,
    find_second_zero,
    make_chunk,
    summarise_step_timing,
)
from controllers.steering.steer import SteerFrames
from mapctl import formats, metrics, report
from mapctl.commands.shared import inputs, options, outputs, streaming
from mapctl.commands.shared.command import ModelCommand, conclude
from mapctl.commands.shared.inputs import read_character
from mapctl.commands.shared.outputs import show_progress
from mapctl.curves.obstacles import Obstacle, measure_clearance
from mapctl.errors import RequestError
from mapctl.features import PRIOR_FPS
from mapctl.ground import Ground
from mapctl.intent.steering import CommandTrack, SteeringLimits, read_commands
from mapctl.motion import join_licences
from mapctl.problem.solution import Outcome, Solution, Status
from mapctl.terms import FootContact
from priors.lstm_gmm.density import LstmGmmDensity
from priors.weight_sets import note_licence

if TYPE_CHECKING:
    from mapctl.streaming.sender import PoseStream

_TURN_RATE_DEG = round(math.degrees(SteeringLimits.turn_rate), 1)


@dataclass(frozen=True)
class Steer(ModelCommand, options.ReadOptions, streaming.StreamOptions):
    """A character follows a script of speeds and directions, as in live steering."""

    commands: Positional[Annotated[Path, arg(metavar="COMMANDS.csv")]]
    """CSV with the columns time_s, speed_mps, heading_deg (0 is +Z, 90 is +X); and, where wanted, facing_deg for
    strafing, turn_deg_s to turn continuously, step_m for a step length, gait and style of the prior,
    left_hand_x, left_hand_y, left_hand_z (and right_hand_, look_) for a point in metres that a hand reaches or that is
    looked at. goto_x_m, goto_z_m, within_s, and where wanted goto_facing_deg and pose (FILE:FRAME), give where the hips
    are to be first, and within how many seconds: the rest of the line holds from then on. The last line's time is the
    end, or a second after the last position is reached."""
    out: options.OutFile
    """Output file: .bvh, .npz, .glb or .usda."""
    realtime: bool = False
    """Play against the wall clock: every step has a deadline and brings the best found by then. On a machine that
    cannot keep up the script's time runs slower than the clock's, which the summary reports."""
    prior: options.Prior = "locomotion-live"
    stitcher: options.MaybeName = None
    """For goto_x_m: the file or run folder of a trained stitcher, which generates the approach; the bundled one if
    not given."""
    rig: options.BodyRig = "canonical"
    liveliness: options.Liveliness = steer.SteerSettings.liveliness
    avoid: options.Avoid = ()
    ground: options.MaybeFile = None
    """TOML file of the ground, where it is not flat (see `mapctl follow --help`): feet are put onto it when the script
    has been played, so it goes without --stream."""
    seed: options.Count = 0
    """Seed of the first pose, and of what is drawn for walks."""
    acceleration: options.Number = SteeringLimits.acceleration
    """Largest acceleration of the target speed, m/s^2."""
    braking: options.Number = SteeringLimits.braking
    """Largest deceleration of the target speed, m/s^2."""
    turn_rate: options.Number = _TURN_RATE_DEG
    """Largest turn rate of the target direction, degrees/s."""
    report: options.MaybeFile = None
    """JSON with each command's response, timing, ledger and measures."""
    strict: bool = False
    """Exit with status 3 where not all that was requested holds: something of a command was not obeyed, a speed was
    lowered to what the prior can do, or a frame was late."""
    quiet: options.Quiet = False


_DETAILS = {
    "steady_speed_mps": "then {:.2f} m/s",
    "steady_heading_error_deg": "{:+.1f} degrees off",
    "steady_facing_error_deg": "facing {:+.1f} degrees off",
    "steady_turn_deg_s": "turning {:.0f} degrees/s",
    "steady_step_m": "steps of {:.2f} m",
    "look_nearest_deg": "head {:.0f} degrees off what it looks at",
    "leftHand_nearest_cm": "left hand {:.0f} cm off",
    "leftHand_held_s": "there for {:.1f} s",
    "rightHand_nearest_cm": "right hand {:.0f} cm off",
    "rightHand_held_s": "there for {:.1f} s",
    "position_error_cm": "{:.2f} cm off",
    "facing_error_deg": "{:.2f} degrees off",
    "pose_error_cm": "joints {:.1f} cm off the pose",
}
_AFTER_SECONDS = 1.0  # for which a motion goes on after the last position was reached
_LAST_COMMAND_SECONDS = 3.0  # seconds for which a script of a single command is played


def run(command: Steer) -> int:
    """Check everything, steer, write, report. Ctrl-C ends the script early; the motion so far is written."""
    options.check_seed(command.seed)
    options.check_liveliness(command.liveliness)
    limits = SteeringLimits(command.acceleration, command.braking, math.radians(command.turn_rate))
    formats.check_ending(command.out)
    outputs.check_files(options.collect_paths(command.out, command.report))
    if command.stream is not None and not command.realtime:
        raise RequestError("--stream goes by the clock, which needs --realtime; give both")
    if command.stream is not None and command.ground is not None:
        raise RequestError("--stream sends frames before they are put onto --ground; leave one out")
    streaming.check(command)
    ground = None if command.ground is None else Ground.read(command.ground)
    track = _read_track(command)
    character, prior = read_character(command.rig, command), priors.load(command.prior)
    track, lowered = track.limit_speed(prior.limits.max_steering_speed)
    for labels in {wanted.labels for wanted in track.commands if wanted.labels}:
        prior.conditioned_on(labels)  # unknown labels are refused now
    stepper: Stepper = steer.step
    if any(wanted.arrival is not None for wanted in track.commands):
        stepper = Arriver(priors.load_stitcher(command.stitcher or "stitcher"))
    elif command.stitcher is not None:
        raise RequestError("--stitcher is for goto_x_m, which the script does not have; leave it out")
    footing = FootContact(rest_height=character.toe_rest_height)
    settings = steer.SteerSettings(limits=limits, liveliness=command.liveliness, footing=footing)
    stream = streaming.open_stream(command, [character.skeleton])
    try:
        recorder, records, frames = _run_steering(command, prior, track, character, settings, stepper, stream)
    finally:
        if stream is not None:
            stream.close()
    motion, footing = recorder.motion(frames), None
    if ground is not None:
        stepped = step_onto_ground(motion, ground, character.toe_rest_height)
        motion, footing = stepped.motion, stepped.measure_footing()
    outputs.save_motion(character.on_rig(motion), command.out)
    starts = [time for time in track.times[1:] if time < motion.seconds]
    timing: dict[str, Any] = {**summarise_step_timing(records, starts), "peak_memory_mb": report.peak_memory_mb()}
    if stream is not None:
        timing["stream"] = asdict(stream.statistics)
    late, sent_late = timing["late_frames"], timing.get("stream", {}).get("late", 0)
    judged = recorder.judge(track, frames)
    notes = [*lowered, *judged["misses"], *(() if footing is None else footing.notes)]
    notes += [f"{late} frames came after they were due"] if late else []
    notes += [f"{sent_late} frames were sent late"] if sent_late else []
    outcome = Outcome.INTERRUPTED if motion.num_frames < frames else Outcome.DONE
    status = Status(outcome).with_notes(notes, infeasible=bool(notes))
    done = Solution(motion, status, recorder.ledger, seconds=sum(piece.seconds for piece in recorder.pieces))
    found = report.build_report(
        done,
        request=options.describe_request("steer", command),
        measures=metrics.measure(motion),
        seed=command.seed,
        prior={"name": prior.name, "licence": prior.card.licence, "quality": prior.card.quality},
        timing=timing,
    )
    found |= judged | ({} if footing is None else {"footing": footing.as_row()})
    if command.report is not None:
        report.write_report(outputs.add_licence(found), command.report)
    if not command.quiet:
        files = options.collect_paths(command.out, command.report)
        streamed = None if stream is None else streaming.summarise(stream)
        print("\n".join(_format_summary(found, files, streamed)))
        if footing is not None:
            print(f"ground    {footing.text}")
    return conclude(status, strict=command.strict)


def _read_track(command: Steer) -> CommandTrack:
    """Read the script, whose commands lead round the obstacles, and note the licences of the motions whose poses it
    names; RequestError where it begins within an obstacle."""
    track, obstacles = read_commands(command.commands), tuple(Obstacle.parse(text) for text in command.avoid)
    arrivals = [wanted.arrival for wanted in track.commands if wanted.arrival is not None]
    poses = [arrival.pose for arrival in arrivals if arrival.pose is not None]
    note_licence(str(command.commands), join_licences(pose.licence for pose in poses))
    clear = float(measure_clearance(obstacles, torch.zeros(2, dtype=torch.float64)))
    if clear < 0:
        raise RequestError(f"the character starts at 0,0, {100 * -clear:.0f} cm within an obstacle")
    return CommandTrack(track.times, tuple(replace(one, obstacles=obstacles) for one in track.commands))


def _run_steering(
    command: Steer,
    prior: LstmGmmDensity,
    track: CommandTrack,
    character: Character,
    settings: steer.SteerSettings,
    stepper: Stepper,
    stream: "PoseStream | None",
) -> tuple[Recorder, list[StepRecord], int]:
    # A script ends when its last command comes, which only marks the end if it is not the only one; an order to be
    # somewhere is carried out, and what comes after it shown for a while.
    by = max((wanted.arrival.by for wanted in track.commands if wanted.arrival is not None), default=0.0)
    alone = track.times[0] + _LAST_COMMAND_SECONDS if len(track.times) == 1 else 0.0
    frames = inputs.count_frames(max(track.times[-1], alone, by + _AFTER_SECONDS if by >= track.times[-1] else 0.0))
    first, recorder = track.commands[0], Recorder()
    generator = torch.Generator().manual_seed(command.seed)
    state, pose = steer.begin(prior, first, generator=generator, settings=settings, skeleton=character.skeleton)
    recorder.show(pose, 0.0)
    steer.warm_up(state, {wanted.labels: wanted for wanted in track.commands}.values(), stepper=stepper)
    clock = WallClock() if command.realtime else StreamClock()
    with show_progress("steering", quiet=command.quiet) as progress:
        displays: list[Display] = [recorder.show]
        if stream is not None and isinstance(clock, WallClock):
            displays.append(_stream_to(stream, clock, frames, find_second_zero(clock, state)))
            displays[-1](pose, 0.0)
        if progress is not None:
            displays.append(
                lambda new, due: progress(min(frames, round(due * PRIOR_FPS) + new.motion.num_frames), frames)
            )
        _, records = drive(state, track.at, displays, frames=frames, clock=clock, stepper=stepper)
    return recorder, records, frames


def _stream_to(stream: "PoseStream", clock: WallClock, frames: int, zero: float) -> Display:
    """Build the display that has a script's frames sent when they are due; `zero` is the clock's time at second 0."""

    def show(new: SteerFrames, due: float) -> None:
        chunk, left = make_chunk(new, clock.perf_counter_at(zero + due), due), frames - round(due * PRIOR_FPS)
        names = ("root", "quats", "contacts", "root_velocity")
        stream.put(0, replace(chunk, **{name: getattr(chunk, name)[:left] for name in names}))

    return show


def _format_command(row: Mapping[str, Any]) -> str:
    """Format what was commanded and what came of it."""
    speed, heading, facing, turn = (row[key] for key in ("speed_mps", "heading_deg", "facing_deg", "turn_deg_s"))
    direction = f" to {heading:.0f} degrees" if turn is None else f" turning {turn:.0f} degrees/s"
    asked = f"{speed:.2f} m/s{direction}" if speed else "stand"
    asked += f" facing {facing:.0f} degrees" if facing is not None and (not speed or facing != heading) else ""
    reached = "not reached" if row["reached_s"] is None else f"reached after {row['reached_s']:.1f} s"
    return f"{row['time_s']:6.1f} s  {asked}: {', '.join([reached, *_format_details(row)])}"


def _format_details(row: Mapping[str, Any]) -> list[str]:
    return [text.format(row[key]) for key, text in _DETAILS.items() if row.get(key) is not None]


def _format_summary(found: Mapping[str, Any], files: Sequence[Path], streamed: str | None) -> list[str]:
    commands = found["commands"]
    lines = [_format_command(row) for row in (commands[:-1] or commands)]
    for row in found["arrivals"]:
        where = f"{row['goto_x_m']:g}, {row['goto_z_m']:g} m"
        lines.append(f"{row['by_s']:6.1f} s  at {where}: {', '.join(_format_details(row))}")
    cost, latency = found["timing"], found["timing"]["command_latency_s"]
    waited = "" if latency is None else f"; a command waits {latency:.2f} s at most"
    slow = f"; too slow here: time stood still for {cost['held_s']:.1f} s" if cost["held_s"] else ""
    return [
        *lines,
        f"cost      {cost['frame_ms_p50']:.1f} ms a frame (p99 {cost['frame_ms_p99']:.1f}), "
        f"{cost['late_frames']} late, {cost['evaluations_per_frame']:.1f} evaluations a frame{waited}{slow}",
        *([] if streamed is None else [streamed]),
        f"status    {found['status']['text']}",
        f"wrote     {', '.join(map(str, files))}",
    ]
