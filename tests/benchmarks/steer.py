"""Steering by random commands of all kinds: which are reached, how soon, errors, sliding, jerk, and ms a frame.

`--model` is a density, `--commands` the number of commands, each of 3.5 to 6 s: walks in any direction, backward, to
the side and diagonally with a facing of its own, turns on the spot, and stands. A command is reached when speed,
direction and facing are near the asked ones and stay so; steady errors count from 2 s after it. `--stand` seconds of
standing after a walk follow: creep of the hips and tremor of the head. Motion matching on the same clips answers the
same commands; feet and jitter of the clips stand beside both.
"""

import math
import time
from collections.abc import Sequence

import scipy
import torch
from common import Row, average, load_circles, parse, print_table, seeded
from follow import average_gait, measure_mocap
from motion_matching import MotionDatabase, steer_by_matching

import priors
from controllers.steering import steer
from controllers.steering.loop import Recorder, drive
from mapctl.features import PRIOR_FPS, encode
from mapctl.intent.steering import Command, CommandTrack
from mapctl.metrics import measure
from mapctl.metrics.travel import measure_commands
from mapctl.motion import Motion
from mapctl.skeleton import CANONICAL

SPEEDS = (0.8, 1.2, 1.6, 2.6)  # m/s
SHARES = {"walk": 0.3, "backward": 0.15, "sideways": 0.15, "diagonal": 0.1, "stand": 0.2, "turn on the spot": 0.1}
TREMOR_HZ = 3.0  # from which on movement of the head is tremor


def draw_commands(count: int, generator: torch.Generator) -> tuple[CommandTrack, list[str]]:
    """Draw commands with their kinds, the first of which walks straight on; a turn on the spot follows a stand."""

    def uniform(low: float, high: float) -> float:
        return low + (high - low) * float(torch.rand((), generator=generator))

    names, chances = list(SHARES), torch.tensor(list(SHARES.values()))
    times, commands, kinds = [0.0], [Command(1.2, 0.0)], ["walk"]
    while len(commands) <= count:
        times.append(times[-1] + uniform(3.5, 6.0))
        facing, side = commands[-1].hips_heading, 1 if uniform(-1, 1) > 0 else -1
        kind = names[int(torch.multinomial(chances, 1, generator=generator))]
        if kind in ("stand", "turn on the spot"):
            kind = "stand" if commands[-1].speed > 0 else "turn on the spot"
        match kind:
            case "walk":
                command = Command(SPEEDS[int(uniform(0, len(SPEEDS)))], uniform(-math.pi, math.pi))
            case "backward":
                command = Command(uniform(0.5, 1.0), facing + math.pi, facing)
            case "sideways":
                command = Command(uniform(0.3, 0.8), facing + side * math.pi / 2, facing)
            case "diagonal":
                command = Command(uniform(0.5, 1.2), facing + side * math.pi / 4, facing)
            case "stand":
                command = Command(0.0, facing)
            case _:
                command = Command(0.0, facing + side * uniform(math.pi / 6, math.pi))
        commands.append(command)
        kinds.append(kind)
    return CommandTrack((*times, times[-1] + 4.0), (*commands, commands[-1])), kinds


def summarise(kind: str, rows: Sequence[dict[str, float | None]]) -> Row:
    """Summarise how commands were obeyed."""

    def sizes(key: str, less: str = "") -> list[float]:
        return [abs(value - (row[less] if less else 0.0)) for row in rows if (value := row[key]) is not None]

    reached = [row["reached_s"] for row in rows if row["reached_s"] is not None]
    speeds, facings = sizes("steady_speed_mps", "speed_mps"), sizes("steady_facing_error_deg")
    headings = sizes("steady_heading_error_deg")
    return {
        "commands": kind,
        "number": len(rows),
        "reached": f"{len(reached) / len(rows):.0%}",
        "in 2 s": f"{sum(seconds <= 2 for seconds in reached) / len(rows):.0%}",
        "after, s": average(reached),
        "worst, s": max(reached, default=None),
        "speed error, m/s": average(speeds),
        "worst, m/s": max(speeds, default=None),
        "heading error, deg": average(headings),
        "worst heading, deg": max(headings, default=None),
        "facing error, deg": average(facings),
        "worst facing, deg": max(facings, default=None),
    }


def measure_stand(motion: Motion) -> Row:
    """Measure creep of the hips over a stand, cm in 30 s, and tremor of the head, cm/s."""
    ground, head = motion.root_position[:, ::2], motion.joint_positions()[:, CANONICAL.index("head")]
    second = round(PRIOR_FPS)
    crept = (ground[-second:].mean(0) - ground[:second].mean(0)).norm() / (motion.seconds - 1) * 30
    return {"creep, cm in 30 s": 100 * float(crept), "tremor, cm/s": measure_tremor(head)}


def measure_tremor(positions: torch.Tensor) -> float:
    """Measure the rms speed of a point above TREMOR_HZ, cm/s."""
    speed = torch.diff(positions, dim=0).numpy() * PRIOR_FPS
    fast = scipy.signal.sosfiltfilt(scipy.signal.butter(4, TREMOR_HZ, "high", fs=PRIOR_FPS, output="sos"), speed, 0)
    return 100 * float((fast**2).sum(-1).mean() ** 0.5)


def judge(name: str, motion: Motion, track: CommandTrack, kinds: Sequence[str], stand: int) -> list[Row]:
    """Judge a motion that was given commands and then `stand` seconds of standing: a row for each kind, one for all."""
    obeyed, found = measure_commands(motion, track)[1:-1], dict[str, list[dict[str, float | None]]]()
    for kind, row in zip(kinds[1:], obeyed, strict=False):
        found.setdefault(kind, []).append(row)
    rows = [summarise(f"{kind}, {name}", found[kind]) for kind in SHARES if kind in found]
    frames = round(track.times[-1] * PRIOR_FPS)
    whole = {**summarise(f"all, {name}", obeyed), **average_gait([measure(motion.slice(0, frames))])}
    if stand:  # from two seconds on
        whole |= measure_stand(motion.slice(frames + round(2 * PRIOR_FPS), motion.num_frames))
    return [*rows, whole]


def main(words: list[str] | None = None) -> None:
    """Measure and print."""
    given = parse(__doc__, words, count=60, model="locomotion-live", commands=200, stand=30)
    circles = load_circles(given, shortest=2.0, longest=30.0, canonical=True, model=given.model)
    track, kinds = draw_commands(given.commands, seeded(given.seed))
    still = Command(0.0, track.commands[-1].hips_heading)
    played = CommandTrack((*track.times, track.times[-1] + given.stand), (*track.commands[:-1], still, still))
    frames = round(played.times[-1] * PRIOR_FPS)
    rows: list[Row] = []
    database = MotionDatabase.of([encode(clip.motion)[0] for circle in circles for clip in circle.clips])
    for name, play in {given.model: _play_density, "motion matching": _play_matching}.items():
        motion, spent = play(given, database, played, frames)
        rows += judge(name, motion, track, kinds, given.stand)
        rows[-1] = {**rows[-1], "ms a frame": 1000 * spent / frames}
    for circle in circles:
        gait = measure_mocap(circle)
        rows.append({"commands": f"{gait['method']}, {circle.name}"} | {k: v for k, v in gait.items() if k != "method"})
    print_table(rows, circles)


def _play_density(given, database: MotionDatabase, track: CommandTrack, frames: int) -> tuple[Motion, float]:
    state, first = steer.begin(priors.load(given.model), track.commands[0], generator=seeded(given.seed))
    recorder = Recorder()
    recorder.show(first, 0.0)
    began = time.process_time()
    drive(state, track.at, [recorder.show], frames=frames)
    return recorder.motion(frames), time.process_time() - began


def _play_matching(given, database: MotionDatabase, track: CommandTrack, frames: int) -> tuple[Motion, float]:
    began = time.process_time()
    motion = steer_by_matching(database, track.at, frames=frames, generator=seeded(given.seed))
    return motion, time.process_time() - began


if __name__ == "__main__":
    main()
