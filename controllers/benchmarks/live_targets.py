"""Benchmark of what steered characters reach for and walk round: random places beside the way, and discs in it."""

import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from controllers.benchmarks.shared.tables import Row
from controllers.steering import steer
from controllers.steering.loop import Recorder, drive
from mapctl.curves.obstacles import Obstacle, measure_clearance
from mapctl.features import PRIOR_FPS
from mapctl.intent.steering import REACHING_HANDS, Command, CommandTrack
from mapctl.metrics.travel import measure_commands
from mapctl.motion import Motion
from mapctl.protocols import Density
from mapctl.skeleton import CANONICAL, TOES

_SECONDS, _TOLD = 6.0, 0.5  # of a walk, and when it is told what to do
_ASIDE, _HEIGHT, _ALONG = (0.25, 0.6), (0.8, 1.6), (2.0, 5.0)  # metres of a place, to its side, up and along the way
_RADIUS, _OFF = (0.3, 0.9), (-0.3, 0.3)  # metres of a disc, and of its middle beside the way
_SPEED = 1.2  # m/s


@dataclass(frozen=True)
class LiveTargetSettings:
    """Size of the benchmark."""

    walks: int = 24
    """Number of walks of each kind."""
    seed: int = 0
    """Seed of places, discs and first poses."""


def benchmark_live_targets(prior: Density, settings: LiveTargetSettings | None = None) -> list[Row]:
    """Measure a row for walks without targets, one for hands that reach in passing, one for who stands, and one for
    discs: how near, for how long, and the largest step and acceleration of hands and toes."""
    settings = settings or LiveTargetSettings()
    kinds = {
        "walking on": _walk_on,
        "reaching in passing": _reach,
        "reaching, standing": _stand,
        "round a disc": _avoid,
    }
    rows = []
    for kind, build in kinds.items():
        generator = torch.Generator().manual_seed(settings.seed)
        found = [_play(prior, build(generator), seed=settings.seed + number) for number in range(settings.walks)]
        rows.append({"targets": kind, **_summarise(found)})
    return rows


def _play(prior: Density, told: Command, *, seed: int) -> tuple[Motion, Command, Row]:
    calm = replace(told, reach={}, look_at=None, obstacles=())
    track = CommandTrack((0.0, _TOLD), (calm, told))
    state, pose = steer.begin(prior, calm, generator=torch.Generator().manual_seed(seed))
    recorder, frames = Recorder(), round(_SECONDS * PRIOR_FPS)
    recorder.show(pose, 0.0)
    drive(state, track, [recorder], frames=frames)
    motion = recorder.motion(frames)
    return motion, told, measure_commands(motion, track)[1]


def _summarise(found: list[tuple[Motion, Command, Row]]) -> Row:
    nearest = [row[name] for _, _, row in found for name in row if name.endswith("_nearest_cm")]
    held = [row[name] for _, _, row in found for name in row if name.endswith("_held_s")]
    discs = [(motion, told.obstacles) for motion, told, _ in found if told.obstacles]
    clear = [100 * float(measure_clearance(each, motion.joint_positions()[..., ::2]).min()) for motion, each in discs]
    return {
        "walks": len(found),
        "within_1_cm_percent": 100 * sum(each < 1 for each in nearest) / len(nearest) if nearest else None,
        "held_s_mean": sum(held) / len(held) if held else None,
        "clearance_cm_least": min(clear, default=None),
        "travelled_m_mean": sum(float(motion.root_position[-1, 2]) for motion, _, _ in found) / len(found),
        **_measure_peaks([motion for motion, _, _ in found]),
    }


def _measure_peaks(motions: list[Motion]) -> Row:
    """Measure the largest speed, m/s, and acceleration, m/s^2, of hands and of toes."""
    peaks: Row = {}
    for name, joints in (("hand", REACHING_HANDS), ("toe", TOES)):
        for unit, order in (("mps", 1), ("mps2", 2)):
            peaks[f"{name}_{unit}_max"] = max(_find_peak(motion, joints, order) for motion in motions)
    return peaks


def _find_peak(motion: Motion, joints: tuple[str, ...], order: int) -> float:
    places: Float[Tensor, "frames joints 3"] = motion.joint_positions()[:, CANONICAL.indices(joints)]
    return float(torch.diff(places, n=order, dim=0).norm(dim=-1).max()) * PRIOR_FPS**order


def _uniform(generator: torch.Generator, low: float, high: float) -> float:
    return low + (high - low) * float(torch.rand((), generator=generator, dtype=torch.float64))


def _walk_on(generator: torch.Generator) -> Command:
    return Command(_SPEED, 0.0)


def _reach(generator: torch.Generator) -> Command:
    hand = REACHING_HANDS[int(torch.randint(2, (1,), generator=generator))]
    side = 1 if hand == "leftHand" else -1
    place = (side * _uniform(generator, *_ASIDE), _uniform(generator, *_HEIGHT), _uniform(generator, *_ALONG))
    return Command(_SPEED, 0.0, reach={hand: place}, look_at=place)


def _stand(generator: torch.Generator) -> Command:
    hand = REACHING_HANDS[int(torch.randint(2, (1,), generator=generator))]
    side, angle = (1 if hand == "leftHand" else -1), _uniform(generator, -0.3, 1.2)
    far, high = _uniform(generator, 0.35, 0.6), _uniform(generator, *_HEIGHT)
    place = (side * far * math.sin(angle), high, far * math.cos(angle))
    return Command(0.0, 0.0, reach={hand: place}, look_at=place)


def _avoid(generator: torch.Generator) -> Command:
    disc = Obstacle((_uniform(generator, *_OFF), _uniform(generator, 3.0, 4.0)), _uniform(generator, *_RADIUS))
    return Command(_SPEED, 0.0, obstacles=(disc,))
