"""Random shots of one to four constraints: how many hold, how many are reported as infeasible, and visible faults.

`--model` is a density, `--shots` the number of shots, of 8 s. Constraints: standing at both ends, a pause, a reach (one
in five too far away), a look, an obstacle. A shot has a silent fault where its status is done and a hand or a toe moves
faster than 5.5 m/s about the hips, or planted toes slide at more than 8 cm/s. Plain walks of the same curves and the
clips of each folder stand beside them.
"""

import time
from collections.abc import Sequence
from dataclasses import replace

import torch
from common import Row, average, load_circles, parse, print_table, seeded

import controllers
import priors
from controllers.shots.request import Look, Reach, ShotRequest
from controllers.shots.shot import ShotSolution, solve_shot
from controllers.shots.trajectory import plan_trajectory
from mapctl import curves
from mapctl.curves.obstacles import Obstacle, measure_clearance
from mapctl.errors import RequestError
from mapctl.features import PRIOR_FPS
from mapctl.intent.path import TimedSpeed
from mapctl.metrics import body, measure
from mapctl.motion import Motion
from mapctl.skeleton import CANONICAL, TOES

CURVES = ("line:8", "wave:0.8x8", "wave:1.2x10", "s:8", "circle:2", "figure8:1.5")
KINDS = ("stand at both ends", "pause", "reach", "look", "obstacle")
ENDS = list(CANONICAL.indices(("leftHand", "rightHand", *TOES)))
FASTEST, SLIDING = 5.5, 8.0  # m/s about the hips; cm/s


def draw_shot(generator: torch.Generator) -> tuple[ShotRequest, tuple[str, ...]]:
    """Draw a shot of one to four constraints, and name their kinds."""

    def uniform(low: float, high: float) -> float:
        return low + (high - low) * float(torch.rand((), generator=generator))

    def choose(count: int) -> int:
        return int(torch.randint(count, (), generator=generator))

    request = ShotRequest(curves.read(CURVES[choose(len(CURVES))]), seconds=8.0)
    order = torch.randperm(len(KINDS), generator=generator).tolist()
    chosen = tuple(KINDS[each] for each in sorted(order[: 1 + choose(4)]))
    if "stand at both ends" in chosen:
        request = replace(request, stand_at_start=True, stand_at_end=True)
    if "pause" in chosen:
        at, speed = uniform(2.5, 4.0), uniform(0.9, 1.3)
        pairs = ((at, speed), (at + 1.0, 0.0), (at + 2.2, 0.0), (at + 3.2, speed))
        request = replace(request, speed=TimedSpeed.parse(pairs))
    if "obstacle" in chosen:
        along, aside = uniform(2.5, 5.0), uniform(-0.4, 0.4)
        x, z = (request.curve.point(along) + aside * request.curve.left(along)).tolist()
        request = replace(request, obstacles=(Obstacle((x, z), uniform(0.2, 0.6)),))
    trajectory = plan_trajectory(request)

    def locate(seconds: float, ahead: float, aside: float) -> tuple[float, float]:
        arc = trajectory.arcs[min(round(seconds * PRIOR_FPS), len(trajectory.arcs) - 1)]
        x, z = (
            trajectory.curve.point(arc) + ahead * trajectory.curve.tangent(arc) + aside * trajectory.curve.left(arc)
        ).tolist()
        return x, z

    if "reach" in chosen:
        while True:
            seconds, left = uniform(2.0, 6.0), bool(choose(2))
            aside = uniform(0.1, 0.55) if choose(5) else uniform(0.9, 1.4)
            x, z = locate(seconds, uniform(0.0, 0.35), aside if left else -aside)
            if float(measure_clearance(request.obstacles, torch.tensor([[x, z]]))) >= 0:
                break
        position = (x, uniform(0.7, 1.7), z)
        reach = Reach(seconds, {"leftHand" if left else "rightHand": position}, uniform(0.0, 0.3))
        request = replace(request, reaches=(reach,))
    if "look" in chosen:
        seconds = uniform(1.0, 6.0)
        x, z = locate(seconds, uniform(1.0, 4.0), uniform(-3.0, 3.0))
        request = replace(request, looks=(Look(seconds, (x, uniform(0.5, 2.0), z), uniform(0.0, 1.0)),))
    return request, chosen


def look_at(motion: Motion) -> dict[str, float]:
    """Measure planted toes, jitter, and the fastest hand or toe about the hips."""
    found, fps = measure(motion), float(motion.fps)
    peaks = body.measure_peaks(motion.joint_positions()[:, ENDS], motion.root_position, fps)
    return {
        "planted toes, cm/s": found["contact_speed_cm_s"],
        "jitter, m/s^3": found["jitter_m_s3"],
        "fastest end, m/s": peaks.step * fps,
    }


def summarise_looks(looks: Sequence[dict[str, float]]) -> Row:
    """Average feet and jitter; the fastest end is the worst of all."""
    means = {name: average([each[name] for each in looks]) for name in looks[0]} if looks else {}
    return means | {name: max(each[name] for each in looks) for name in means if name.startswith("fastest")}


def summarise(kind: str, shots: Sequence[ShotSolution | None]) -> Row:
    """Summarise shots; None was refused."""
    solved = [shot for shot in shots if shot is not None]
    looks = [look_at(shot.motion) for shot in solved]
    held = [constraint.holds for shot in solved for constraint in shot.constraints]
    # A body that glides plants no toe: NaN is within no limit.
    faults = [
        shot.status.ok and not (look["fastest end, m/s"] <= FASTEST and look["planted toes, cm/s"] <= SLIDING)
        for shot, look in zip(solved, looks, strict=True)
    ]
    infeasible = sum(not shot.status.ok for shot in solved)
    return {
        "shots with": kind,
        "shots": len(shots),
        "constraints that hold": f"{sum(held)} of {len(held)}",
        "all hold": len(solved) - infeasible - sum(faults),
        "infeasible": infeasible,
        "refused": len(shots) - len(solved),
        "silent faults": sum(faults),
        **summarise_looks(looks),
    }


def main(words: list[str] | None = None) -> None:
    """Measure and print."""
    given = parse(__doc__, words, count=60, model="locomotion", shots=20)
    circles = load_circles(given, shortest=2.0, longest=30.0, canonical=True, model=given.model)
    prior, inbetweener = priors.load(given.model), priors.load_inbetweener("transformer")
    generator = seeded(given.seed)
    shots: list[tuple[tuple[str, ...], ShotSolution | None]] = []
    walks, spent, frames = [], 0.0, 0
    for number in range(given.shots):
        request, kinds = draw_shot(generator)
        began = time.process_time()
        try:
            shot = solve_shot(prior, inbetweener, request, generator=seeded(number))
            spent, frames = spent + time.process_time() - began, frames + shot.motion.num_frames
        except RequestError:
            shot = None
        shots.append((kinds, shot))
        walks.append(controllers.follow(prior, request.curve, seconds=8.0, generator=seeded(number)).motion)
    rows = [
        summarise(kind, [shot for kinds, shot in shots if kind in kinds])
        for kind in KINDS
        if any(kind in kinds for kinds, _ in shots)
    ]
    rows.append({**summarise("any", [shot for _, shot in shots]), "ms a frame": 1000 * spent / max(1, frames)})
    rows.append({"shots with": "nothing: plain walks", **summarise_looks([look_at(walk) for walk in walks])})
    for circle in circles:
        looks = summarise_looks([look_at(clip.motion) for clip in circle.clips])
        rows.append({"shots with": f"clips of {circle.name}", **looks})
    print_table(rows, circles)


if __name__ == "__main__":
    main()
