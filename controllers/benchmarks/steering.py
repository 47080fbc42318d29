"""Benchmark of steering: random commands one after the other, which are reached, how soon, and the cost of a frame; and
starts from a stand into every direction."""

import math
import statistics
from dataclasses import dataclass
from itertools import pairwise

import torch

from controllers.benchmarks.shared.tables import Row
from controllers.steering import steer
from controllers.steering.loop import Recorder, StepRecord, drive, summarise_step_timing
from controllers.steering.pure_pursuit import PurePursuit
from mapctl import curves
from mapctl.features import PRIOR_FPS
from mapctl.intent.steering import Command, CommandTrack
from mapctl.metrics import measure
from mapctl.metrics.travel import measure_commands
from mapctl.motion import Motion
from mapctl.protocols import Density

_SPEEDS = (0.0, 0.8, 1.2, 1.6, 2.6)
_TURNS = (0, 60, 120, 180, -120, -60)  # degrees from where a standing character faces to where it is to go
_STAND_SECONDS, _GO_SECONDS, _GO_SPEED = 4.0, 4.0, 1.2


@dataclass(frozen=True)
class SteeringBenchmarkSettings:
    """Size of the benchmark."""

    commands: int = 48
    """Number of commands, each of a random speed and direction."""
    shortest: float = 3.5
    """Shortest time for which a command holds, seconds."""
    longest: float = 6.0
    """Longest time for which a command holds, seconds."""
    seed: int = 0
    """Seed of the commands and the first pose."""


def benchmark_steering(prior: Density, settings: SteeringBenchmarkSettings | None = None) -> list[Row]:
    """Measure a row for each kind of change, and one for all with cost and feet."""
    settings = settings or SteeringBenchmarkSettings()
    generator = torch.Generator().manual_seed(settings.seed)
    track = _sample_command_track(settings, generator)
    motion, records = _walk(prior, track, generator)
    rows = measure_commands(motion, track)[:-1]
    kinds: dict[str, list[Row]] = {}
    for (before, after), row in zip(pairwise(track.commands), rows[1:], strict=False):
        kinds.setdefault(_classify_change(before, after), []).append(row)
    cost, feet = summarise_step_timing(records), measure(motion)
    whole = {name: cost[name] for name in ("frame_ms_p50", "frame_ms_p99")}
    whole |= {name: feet[name] for name in ("contact_speed_cm_s", "jitter_m_s3")}
    return [
        *({"change": kind, **_summarise_commands(kind_rows)} for kind, kind_rows in sorted(kinds.items())),
        {"change": "all", **_summarise_commands(rows[1:]), **whole},
    ]


def benchmark_starts(prior: Density, characters: int = 8) -> list[Row]:
    """Measure how soon characters that stand are under way at 1.2 m/s, a row for each angle that they turn by."""
    times, commands, heading = [0.0], [Command(_GO_SPEED, 0.0)], 0.0
    for turn in _TURNS:
        stands = times[-1] + _STAND_SECONDS
        times += [stands, stands + _GO_SECONDS]
        commands.append(Command(0.0, heading))
        heading += math.radians(turn)
        commands.append(Command(_GO_SPEED, heading))
    times.append(times[-1] + _GO_SECONDS)
    track = CommandTrack(tuple(times), (*commands, commands[-1]))
    found: dict[int, list[Row]] = {}
    for seed in range(characters):
        motion, _ = _walk(prior, track, torch.Generator().manual_seed(seed))
        for turn, row in zip(_TURNS, measure_commands(motion, track)[2:-1:2], strict=True):
            found.setdefault(abs(turn), []).append(row)
    return [
        {"change": f"from a stand, turning by {turn} degrees", **_summarise_commands(rows)}
        for turn, rows in sorted(found.items())
    ]


def benchmark_pursuit(prior: Density, seed: int = 0) -> list[Row]:
    """Measure curves walked live at 1 m/s by pure pursuit half a metre ahead."""
    columns = ("path_error_mean_cm", "path_error_max_cm", "contact_speed_cm_s", "jitter_m_s3")
    rows = []
    for name, seconds in (("circle:2", 13.0), ("wave:1x8", 8.5)):
        curve = curves.read(name)
        pursuit, recorder = PurePursuit(curve, speed=1.0), Recorder()
        x, z = curve.point(0.0)[[0, -1]].tolist()
        state, first = steer.begin(prior, pursuit.first, generator=torch.Generator().manual_seed(seed), at=(x, z))
        recorder.show(first, 0.0)
        drive(state, pursuit, [recorder, pursuit], frames=round(seconds * PRIOR_FPS))
        found = measure(recorder.motion(), curve)
        rows.append({"change": f"live along {name}", **{key: found[key] for key in columns}})
    return rows


def _walk(prior: Density, track: CommandTrack, generator: torch.Generator) -> tuple[Motion, list[StepRecord]]:
    """Steer a character through a track to its last command, without a deadline."""
    state, first = steer.begin(prior, track.commands[0], generator=generator)
    recorder = Recorder()
    recorder.show(first, 0.0)
    frames = round(track.times[-1] * PRIOR_FPS)
    _, records = drive(state, track, [recorder], frames=frames)
    return recorder.motion(frames), records


def _sample_command_track(settings: SteeringBenchmarkSettings, generator: torch.Generator) -> CommandTrack:
    def uniform(low: float, high: float) -> float:
        return low + (high - low) * float(torch.rand((), generator=generator, dtype=torch.float64))

    times, commands = [0.0], [Command(1.2, 0.0)]
    for _ in range(settings.commands):
        times.append(times[-1] + uniform(settings.shortest, settings.longest))
        speed = _SPEEDS[int(torch.randint(len(_SPEEDS), (1,), generator=generator))]
        commands.append(Command(speed, uniform(-math.pi, math.pi)))
    times.append(times[-1] + settings.longest)
    return CommandTrack(tuple(times), (*commands, commands[-1]))


def _classify_change(before: Command, after: Command) -> str:
    if after.speed == 0:
        return "to a stand"
    sharp = abs(math.remainder(after.heading - before.heading, 2 * math.pi)) > math.pi / 2
    came = "from a stand" if before.speed == 0 else "moving"
    return f"{came}, turning by more than 90 degrees" if sharp else f"{came}, turning by less"


def _summarise_commands(rows: list[Row]) -> Row:
    reached = [row["reached_s"] for row in rows if row["reached_s"] is not None]
    under_way = [row["under_way_s"] for row in rows if row["under_way_s"] is not None]
    errors = [abs(row["steady_heading_error_deg"]) for row in rows if row["steady_heading_error_deg"] is not None]
    return {
        "commands": len(rows),
        "reached": len(reached),
        "seconds_mean": statistics.mean(reached) if reached else None,
        "seconds_max": max(reached, default=None),
        "under_way_s_mean": statistics.mean(under_way) if under_way else None,
        "under_way_s_max": max(under_way, default=None),
        "direction_off_deg_median": statistics.median(errors) if errors else None,
    }
