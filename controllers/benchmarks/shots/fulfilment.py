"""Benchmark of shots: random wishes that are to hold at once, how many do, which are told not to, and how it looks."""

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch

from controllers.benchmarks.shared.bones import put_on_generated_bones
from controllers.benchmarks.shared.tables import Row
from controllers.following.follow import follow
from controllers.shots.planning.way import plan_way
from controllers.shots.request import Look, Reach, ShotRequest
from controllers.shots.shot import ShotSolution, solve_shot
from mapctl import curves
from mapctl.curves.obstacles import Obstacle, measure_clearance
from mapctl.errors import RequestError
from mapctl.features import PRIOR_FPS
from mapctl.intent.timed_speed import TimedSpeed
from mapctl.metrics import body, feet, worst_frame
from mapctl.metrics.realism import measure_realism
from mapctl.motion import Motion
from mapctl.protocols import Density, Inbetweener
from mapctl.skeleton import CANONICAL, TOES

_CURVES = ("line:8", "wave:0.8x8", "wave:1.2x10", "s:8", "circle:2", "figure8:1.5")
_MOST_WISHES = 4
_TOES = CANONICAL.indices(TOES)
_EFFECTORS = CANONICAL.indices(("leftHand", "rightHand", *TOES))
_FASTEST_STEP, _FASTEST_PLANTED = 5.5, 0.08
"""Speed of a hand or a toe about the hips, and of planted toes, m/s, beyond which a viewer sees a fault."""


@dataclass(frozen=True, eq=False)
class _Made:
    """A solved shot, or the refusal of one."""

    kinds: tuple[str, ...]
    solution: ShotSolution | None
    frame_ms: float


def benchmark_shots(
    prior: Density,
    inbetweener: Inbetweener,
    *,
    count: int,
    seed: int = 0,
    mocap: Sequence[Motion] = (),
    progress: Callable[[int, int], None] | None = None,
) -> list[Row]:
    """Solve random shots of one to four wishes: rows by kind of wish, and of all beside plain walks of the same curves;
    with `mocap`, at PRIOR_FPS, how often a classifier tells these two sets from it, and halves of it from each other.

    A shot has failed silently if its status is done and a viewer would see a fault: a hand or a toe that moves faster
    than 5.5 m/s about the hips, planted toes at more than 8 cm/s, or toes that are never planted.
    """
    generator = torch.Generator().manual_seed(seed)
    made, walks = [], []
    for number in range(count):
        request, kinds = draw_shot(generator)
        began = time.perf_counter()
        try:
            solution = solve_shot(prior, inbetweener, request, generator=torch.Generator().manual_seed(number))
        except RequestError:
            made.append(_Made(kinds, None, 0.0))
            continue
        cost = 1000 * (time.perf_counter() - began) / solution.motion.num_frames
        made.append(_Made(kinds, solution, cost))
        began = time.perf_counter()
        alone = follow(prior, request.curve, seconds=8.0, generator=torch.Generator().manual_seed(number)).motion
        walks.append((alone, 1000 * (time.perf_counter() - began) / alone.num_frames))
        if progress is not None:
            progress(number + 1, count)
    named = sorted({kind for each in made for kind in each.kinds})
    rows = [_summarise(kind, [each for each in made if kind in each.kinds]) for kind in named]
    rows.append(_summarise("all", made))
    if walks:
        cost = sum(ms for _, ms in walks) / len(walks)
        rows.append(
            {"wishes": "walk alone", "shots": len(walks), **_measure([one for one, _ in walks]), "frame_ms": cost}
        )
        if mocap:
            shots = [each.solution.motion for each in made if each.solution is not None]
            rows[-2:] = [
                row | _tell_apart(motions, mocap, seed)
                for row, motions in zip(rows[-2:], (shots, [one for one, _ in walks]), strict=True)
            ]
    return rows


def _tell_apart(motions: Sequence[Motion], mocap: Sequence[Motion], seed: int) -> Row:
    """Measure in what share of one-second windows a classifier tells motions from mocap, and mocap from itself."""
    real = [put_on_generated_bones(clip) for clip in mocap]
    found = measure_realism(motions, real, generator=torch.Generator().manual_seed(seed))
    return {"told_apart_pct": 100 * found.accuracy, "mocap_told_apart_pct": 100 * found.floor_accuracy}


def draw_shot(generator: torch.Generator) -> tuple[ShotRequest, tuple[str, ...]]:
    """Draw a shot of one to four wishes, and name them; some of the reaches are far from the way."""

    def uniform(low: float, high: float) -> float:
        return low + (high - low) * float(torch.rand((), generator=generator))

    def choose(count: int) -> int:
        return int(torch.randint(count, (), generator=generator))

    request = ShotRequest(curves.read(_CURVES[choose(len(_CURVES))]), seconds=8.0)
    kinds = ("stand at both ends", "pause", "reach", "look", "obstacle")
    order = torch.randperm(len(kinds), generator=generator).tolist()
    chosen = tuple(kinds[each] for each in sorted(order[: 1 + choose(_MOST_WISHES)]))
    if "stand at both ends" in chosen:
        request = replace(request, stand_at_start=True, stand_at_end=True)
    if "pause" in chosen:
        at, speed = uniform(2.5, 4.0), uniform(0.9, 1.3)
        pairs = ((at, speed), (at + 1.0, 0.0), (at + 2.2, 0.0), (at + 3.2, speed))
        request = replace(request, speed=TimedSpeed.parse(pairs))
    if "obstacle" in chosen:
        along, aside = uniform(2.5, 5.0), uniform(-0.4, 0.4)
        centre = request.curve.point(along) + aside * request.curve.left(along)
        request = replace(request, obstacles=(Obstacle((float(centre[0]), float(centre[1])), uniform(0.2, 0.6)),))
    way = plan_way(request)
    if "reach" in chosen:
        while True:
            seconds, left = uniform(2.0, 6.0), bool(choose(2))
            aside = uniform(0.1, 0.55) if choose(5) else uniform(0.9, 1.4)
            place = _find_place(way, seconds, ahead=uniform(0.0, 0.35), aside=aside if left else -aside)
            if float(measure_clearance(request.obstacles, torch.tensor([place]))) >= 0:
                break
        limb, height = "leftHand" if left else "rightHand", uniform(0.7, 1.7)
        reach = Reach(seconds, {limb: (place[0], height, place[1])}, uniform(0.0, 0.3))
        request = replace(request, reaches=(reach,))
    if "look" in chosen:
        seconds = uniform(1.0, 6.0)
        place = _find_place(way, seconds, ahead=uniform(1.0, 4.0), aside=uniform(-3.0, 3.0))
        request = replace(request, looks=(Look(seconds, (place[0], uniform(0.5, 2.0), place[1]), uniform(0.0, 1.0)),))
    return request, chosen


def _find_place(way, seconds: float, *, ahead: float, aside: float) -> list[float]:
    arc = way.arcs[min(round(seconds * PRIOR_FPS), len(way.arcs) - 1)]
    place = way.curve.point(arc) + ahead * way.curve.tangent(arc) + aside * way.curve.left(arc)
    return [float(place[0]), float(place[-1])]


def _summarise(kind: str, made: list[_Made]) -> Row:
    solved = [each for each in made if each.solution is not None]
    done = [each.solution.status.ok for each in solved if each.solution is not None]
    motions = [each.solution.motion for each in solved if each.solution is not None]
    silent = sum(ok and _shows_fault(motion) for ok, motion in zip(done, motions, strict=True))
    share = 100 / max(1, len(made))
    return {
        "wishes": kind,
        "shots": len(made),
        "fulfilled_pct": share * (sum(done) - silent),
        "told_infeasible_pct": share * (len(done) - sum(done)),
        "refused_pct": share * (len(made) - len(solved)),
        "failed_silently_pct": share * silent,
        **_measure(motions),
        "frame_ms": sum(each.frame_ms for each in solved) / max(1, len(solved)),
    }


def _shows_fault(motion: Motion) -> bool:
    found = _measure([motion])
    # A body that glides never plants a toe, and NaN is not within any limit.
    return not (found["step_m_s"] <= _FASTEST_STEP and found["planted_cm_s"] <= 100 * _FASTEST_PLANTED)


def _measure(motions: list[Motion]) -> Row:
    """Measure what a viewer sees: feet and jitter as means, the worst step and acceleration of all."""
    planted, jitter, steps, accelerations = [], [], [], []
    for motion in motions:
        positions = motion.joint_positions()
        toes = feet.ToeMeasurements.of(positions[:, _TOES], PRIOR_FPS)
        planted.append(100 * feet.contact_speed(toes))
        jitter.append(body.jitter(positions, PRIOR_FPS))
        peaks = worst_frame.measure_peaks(positions[:, _EFFECTORS], motion.root_position, PRIOR_FPS)
        steps.append(peaks.step * PRIOR_FPS)
        accelerations.append(peaks.acceleration)
    return {
        "planted_cm_s": _average(planted),
        "jitter_m_s3": _average(jitter),
        "step_m_s": max(steps, default=0.0),
        "acceleration_m_s2": max(accelerations, default=0.0),
    }


def _average(values: Sequence[float]) -> float:
    """Average what is a number; NaN where nothing is."""
    known = [value for value in values if not math.isnan(value)]
    return sum(known) / len(known) if known else math.nan
