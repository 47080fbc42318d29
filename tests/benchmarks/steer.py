"""Steering by random commands of speed and direction: which are reached, how soon, steady errors, and ms a frame.

`--model` is a density, `--commands` the number of commands, each of 3.5 to 6 s. A command is reached when speed and
direction are near the asked ones and stay so; steady errors count from 2 s after it. Feet and jitter of the clips of
each folder stand beside those of the walk.
"""

import math
import time
from collections.abc import Sequence
from itertools import pairwise

import torch
from common import Row, average, load_circles, parse, print_table, seeded
from follow import average_gait, measure_mocap

import priors
from controllers.steering import steer
from controllers.steering.loop import Recorder, drive
from mapctl.features import PRIOR_FPS
from mapctl.intent.steering import Command, CommandTrack
from mapctl.metrics import measure
from mapctl.metrics.travel import measure_commands

SPEEDS = (0.0, 0.8, 1.2, 1.6, 2.6)  # m/s


def draw_commands(count: int, generator: torch.Generator) -> CommandTrack:
    """Draw commands, the first of which walks straight on."""

    def uniform(low: float, high: float) -> float:
        return low + (high - low) * float(torch.rand((), generator=generator))

    times, commands = [0.0], [Command(1.2, 0.0)]
    for _ in range(count):
        times.append(times[-1] + uniform(3.5, 6.0))
        speed = SPEEDS[int(torch.randint(len(SPEEDS), (), generator=generator))]
        commands.append(Command(speed, uniform(-math.pi, math.pi)))
    return CommandTrack((*times, times[-1] + 6.0), (*commands, commands[-1]))


def classify(before: Command, after: Command) -> str:
    """Return the kind of a change."""
    if after.speed == 0:
        return "to a stand"
    sharp = abs(math.remainder(after.heading - before.heading, 2 * math.pi)) > math.pi / 2
    return f"{'from a stand' if before.speed == 0 else 'moving'}, turn of {'more' if sharp else 'less'} than 90 degrees"


def summarise(kind: str, rows: Sequence[dict[str, float | None]]) -> Row:
    """Summarise how commands were obeyed."""
    reached = [row["reached_s"] for row in rows if row["reached_s"] is not None]
    speeds = [abs(s - row["speed_mps"]) for row in rows if (s := row["steady_speed_mps"]) is not None]
    headings = [abs(error) for row in rows if (error := row["steady_heading_error_deg"]) is not None]
    return {
        "change": kind,
        "commands": len(rows),
        "reached": f"{len(reached) / len(rows):.0%}",
        "after, s": average(reached),
        "worst, s": max(reached, default=None),
        "speed error, m/s": average(speeds),
        "worst, m/s": max(speeds, default=None),
        "heading error, deg": average(headings),
        "worst, deg": max(headings, default=None),
    }


def main(words: list[str] | None = None) -> None:
    """Measure and print."""
    given = parse(__doc__, words, count=60, model="locomotion-live", commands=40)
    circles = load_circles(given, shortest=2.0, longest=30.0, canonical=True, model=given.model)
    generator = seeded(given.seed)
    track = draw_commands(given.commands, generator)
    state, first = steer.begin(priors.load(given.model), track.commands[0], generator=generator)
    recorder = Recorder()
    recorder.show(first, 0.0)
    frames = round(track.times[-1] * PRIOR_FPS)
    began = time.process_time()
    drive(state, track.at, [recorder.show], frames=frames)
    spent, motion = time.process_time() - began, recorder.motion(frames)
    kinds: dict[str, list[dict[str, float | None]]] = {}
    obeyed = measure_commands(motion, track)[:-1]
    for (before, after), row in zip(pairwise(track.commands), obeyed[1:], strict=False):
        kinds.setdefault(classify(before, after), []).append(row)
    rows = [summarise(kind, found) for kind, found in sorted(kinds.items())]
    whole = {**summarise(f"all, {given.model}", obeyed[1:]), **average_gait([measure(motion)])}
    rows.append({**whole, "ms a frame": 1000 * spent / frames})
    for circle in circles:
        gait = measure_mocap(circle)
        rows.append({"change": f"{gait['method']}, {circle.name}"} | {k: v for k, v in gait.items() if k != "method"})
    print_table(rows, circles)


if __name__ == "__main__":
    main()
