"""Random shots of one to four constraints on the bodies of clips: how many hold, are refused, or have silent faults.

`--model` is a density, `--shots` the number of shots; `--print` lists every shot. Curves: lines of 0.2 to 8 m, waves,
circles, and there and back again. Constraints: standing at both ends, a pause, a position aside, a reach (one in five
too far away), a look, an obstacle, a clip to go on from or to end in. A silent fault: the status is done, and a foot
glides by more than 4 cm (15 beyond 2 m/s), a planted toe slides by more than 5 cm, or a joint accelerates by more than
90 m/s^2. The clips of each folder stand beside them.
"""

import time
from collections.abc import Sequence
from dataclasses import replace

import torch
from common import Row, average, load_circles, parse, print_table, seeded

import priors
from controllers.shots.request import Arrival, Lead, Look, PoseKey, Reach, ShotRequest
from controllers.shots.shot import ShotSolution, solve_shot
from controllers.shots.trajectory import plan_trajectory
from controllers.shots.walk import FollowSettings
from mapctl import curves
from mapctl.curves.obstacles import Obstacle, measure_clearance
from mapctl.errors import RequestError
from mapctl.features import PRIOR_FPS
from mapctl.intent.path import TimedSpeed
from mapctl.metrics import measure
from mapctl.motion import Motion
from mapctl.retarget.carry import RiggedCharacter

CURVES = ("wave:0.8x8", "wave:1.2x10", "s:8", "circle:2", "figure8:1.5")
BACK = torch.tensor([[0.0, 0.0], [0.0, 3.0], [0.3, 0.4]], dtype=torch.float64)
KINDS = ("stand at both ends", "pause", "position", "reach", "look", "obstacle", "begin in a clip", "end in a clip")
GLIDE, GLIDE_RUNNING, SLIDE, ACCELERATION = 4.0, 15.0, 5.0, 90.0  # cm, cm, cm, m/s^2


def draw_shot(generator: torch.Generator, clip: Motion) -> tuple[ShotRequest, tuple[str, ...]]:
    """Draw a shot of one to four constraints, and name their kinds; the clip is on canonical joints."""

    def uniform(low: float, high: float) -> float:
        return low + (high - low) * float(torch.rand((), generator=generator))

    def choose(count: int) -> int:
        return int(torch.randint(count, (), generator=generator))

    kind = choose(4)
    if kind == 0:
        curve = curves.line(length=0.2 * 40 ** uniform(0, 1))
    elif kind == 1:
        curve = curves.from_points(BACK * uniform(0.6, 1.5), closed=False)
    else:
        curve = curves.read(CURVES[choose(len(CURVES))])
    order = torch.randperm(len(KINDS), generator=generator).tolist()
    chosen = [KINDS[each] for each in sorted(order[: 1 + choose(4)])]
    for one, other in (("begin in a clip", "end in a clip"), ("stand at both ends", "end in a clip")):
        if one in chosen and other in chosen:
            chosen.remove(other)
    if "stand at both ends" in chosen or kind < 2:
        ends = {"stand_at_start": "begin in a clip" not in chosen, "stand_at_end": "end in a clip" not in chosen}
    else:
        ends = {"stand_at_start": False, "stand_at_end": False}
    request = ShotRequest(curve, seconds=None if kind < 2 else 8.0, **ends)
    if "begin in a clip" in chosen:
        lead = Lead.of(clip, 2 + choose(clip.num_frames - 2))
        request = replace(request, lead=lead.bring_to(curve))
    if "end in a clip" in chosen:
        request = replace(request, arrival=Arrival.of(clip, choose(clip.num_frames - 3)))
    if "pause" in chosen and kind >= 2:
        at, speed = uniform(2.5, 4.0), uniform(0.9, 1.3)
        pairs = ((at, speed), (at + 1.0, 0.0), (at + 2.2, 0.0), (at + 3.2, speed))
        request = replace(request, speed=TimedSpeed.parse(pairs))
    if "obstacle" in chosen and curve.length > 4:
        along, aside = uniform(0.3, 0.7) * curve.length, uniform(-0.4, 0.4)
        x, z = (curve.point(along) + aside * curve.left(along)).tolist()
        request = replace(request, obstacles=(Obstacle((x, z), uniform(0.2, 0.6)),))
    trajectory = plan_trajectory(request)
    last = len(trajectory.arcs) / PRIOR_FPS

    def locate(seconds: float, ahead: float, aside: float) -> tuple[float, float]:
        arc = trajectory.arcs[min(round(seconds * PRIOR_FPS), len(trajectory.arcs) - 1)]
        x, z = (
            trajectory.curve.point(arc) + ahead * trajectory.curve.tangent(arc) + aside * trajectory.curve.left(arc)
        ).tolist()
        return x, z

    if "position" in chosen:
        seconds = uniform(0.3, 0.7) * last
        request = replace(request, poses=(PoseKey(seconds, place=locate(seconds, 0.0, uniform(-0.4, 0.4))),))
    if "reach" in chosen:
        while True:
            seconds, left = uniform(0.3, 0.7) * last, bool(choose(2))
            aside = uniform(0.1, 0.55) if choose(5) else uniform(0.9, 1.4)
            x, z = locate(seconds, uniform(0.0, 0.35), aside if left else -aside)
            if float(measure_clearance(request.obstacles, torch.tensor([[x, z]]))) >= 0:
                break
        position = (x, uniform(0.7, 1.7), z)
        reach = Reach(seconds, {"leftHand" if left else "rightHand": position}, uniform(0.0, 0.3))
        request = replace(request, reaches=(reach,))
    if "look" in chosen:
        seconds = uniform(0.2, 0.7) * last
        x, z = locate(seconds, uniform(1.0, 4.0), uniform(-3.0, 3.0))
        request = replace(request, looks=(Look(seconds, (x, uniform(0.5, 2.0), z), uniform(0.0, 0.5)),))
    return request, tuple(chosen)


def look_at(motion: Motion) -> dict[str, float]:
    """Measure what is visible: the worst frames, and the longest slide of a planted toe."""
    found = measure(motion)
    return {
        "glide, cm": found["glide_cm"],
        "slide, cm": found["slide_max_cm"],
        "acceleration, m/s^2": found["acceleration_max_m_s2"],
        "jitter, m/s^3": found["jitter_m_s3"],
    }


def is_faulty(look: dict[str, float], motion: Motion) -> bool:
    """Return whether a viewer sees a fault."""
    speed = float(motion.root_position[:, ::2].diff(dim=0).norm(dim=-1).max()) * float(motion.fps)
    glide = GLIDE if speed < 2.0 else GLIDE_RUNNING
    return look["glide, cm"] > glide or not look["slide, cm"] <= SLIDE or look["acceleration, m/s^2"] > ACCELERATION


def summarise_looks(looks: Sequence[dict[str, float]]) -> Row:
    """Average the jitter; of the others the worst."""
    names = looks[0] if looks else ()
    return {
        ("" if "jitter" in name else "largest ") + name: (average if "jitter" in name else max)(
            [each[name] for each in looks]
        )
        for name in names
    }


def summarise(kind: str, shots: Sequence[ShotSolution | None]) -> Row:
    """Summarise shots; None was refused."""
    solved = [shot for shot in shots if shot is not None]
    looks = [look_at(shot.motion) for shot in solved]
    held = [constraint.holds for shot in solved for constraint in shot.constraints]
    faults = [shot.status.ok and is_faulty(look, shot.motion) for shot, look in zip(solved, looks, strict=True)]
    infeasible = sum(not shot.status.ok for shot in solved)
    done = [look for shot, look in zip(solved, looks, strict=True) if shot.status.ok]
    return {
        "shots with": kind,
        "shots": len(shots),
        "constraints that hold": f"{sum(held)} of {len(held)}",
        "all hold": len(solved) - infeasible,
        "infeasible": infeasible,
        "refused": len(shots) - len(solved),
        "silent faults": sum(faults),
        **summarise_looks(done),
    }


def main(words: list[str] | None = None) -> None:
    """Measure and print."""
    given = parse(__doc__, words, count=20, model="locomotion", shots=60, print=False)
    circles = load_circles(given, shortest=2.0, longest=30.0, model=given.model)
    prior, inbetweener = priors.load(given.model), priors.load_inbetweener("transformer")
    generator, shots = seeded(given.seed), list[tuple[tuple[str, ...], ShotSolution | None]]()
    spent, frames = 0.0, 0
    for number in range(given.shots):
        clips = circles[number % len(circles)].clips
        canonical, rigged = RiggedCharacter.of(clips[number // len(circles) % len(clips)].motion)
        settings = FollowSettings().with_rest_height(float(rigged.stance.toe_height.mean()))
        began, kinds, length = time.process_time(), (), 0.0
        try:
            request, kinds = draw_shot(generator, canonical)
            length = request.curve.length
            shot = solve_shot(
                prior, inbetweener, request, generator=seeded(number), settings=settings, skeleton=canonical.skeleton
            )
            spent, frames = spent + time.process_time() - began, frames + shot.motion.num_frames
            line = f"{shot.status.text}; {look_at(shot.motion)}"
        except RequestError as error:
            shot, line = None, f"refused: {error}"
        if given.print:
            print(number, f"{length:.1f} m;", ", ".join(kinds), "->", line, flush=True)
        shots.append((kinds, shot))
    rows = [
        summarise(kind, [shot for kinds, shot in shots if kind in kinds])
        for kind in KINDS
        if any(kind in kinds for kinds, _ in shots)
    ]
    rows.append({**summarise("any", [shot for _, shot in shots]), "ms a frame": 1000 * spent / max(1, frames)})
    for circle in circles:
        looks = summarise_looks([look_at(RiggedCharacter.of(clip.motion)[0]) for clip in circle.clips])
        rows.append({"shots with": f"clips of {circle.name}", **looks})
    print_table(rows, circles)


if __name__ == "__main__":
    main()
