"""Retargeting to a robot beside inverse kinematics of each frame alone (mink), on the same targets.

`--robot` is an MJCF with a free base; mink and a solver of quadratic programmes must be installed (`pip install mink
daqp`). Of feet and hands the distance from their targets; of the tips of standing soles their speed; of joints the mean
third difference of angles; and the time of a frame.
"""

from collections.abc import Mapping
from fractions import Fraction
from time import perf_counter

import mink
import numpy as np
import torch
from common import load_circles, parse, print_table

from mapctl import rotations
from mapctl.retarget.carry import retarget_motion
from mapctl.robots import model
from mapctl.robots.retarget import Observations, RobotMotion, observe, retarget_to_robot

ITERATIONS, TOE_METRES = 10, 0.01  # of mink in each frame; error of an ankle's position


def solve_frames(robot: model.Robot, seen: Observations, fps: Fraction) -> RobotMotion:
    """Solve each frame alone, from the frame before: positions and orientations of the same links, as exactly."""
    configuration, limits = mink.Configuration(robot.model), [mink.ConfigurationLimit(robot.model)]
    tasks = []
    for number, link in enumerate(seen.links):
        if seen.points[number].norm() == 0:
            costs = [
                float(weights[:, number].median().sqrt())
                for weights in (seen.position_weights, seen.orientation_weights)
            ]
            ankle = robot.skeleton.names[link] in robot.skeleton.end_offsets
            costs = [1 / TOE_METRES, 1 / 0.15] if ankle else costs
            tasks.append((number, mink.FrameTask(robot.skeleton.names[link], "body", *costs, lm_damping=1e-3)))
    posture = mink.PostureTask(robot.model, cost=1.0)
    rest = robot.model.qpos0.copy()
    rest[7:] = 0
    posture.set_target(rest)
    start = np.concatenate([seen.positions[0, 0].numpy(), [1, 0, 0, 0], np.zeros(len(robot.joints))])
    configuration.update(start)
    quats = rotations.from_matrix(seen.orientations @ robot.zero[seen.links]).roll(1, dims=-1).numpy()
    found = []
    for frame in range(len(seen.positions)):
        for number, task in tasks:
            pose = np.concatenate([quats[frame, number], seen.positions[frame, number].numpy()])
            task.set_target(mink.SE3(wxyz_xyz=pose))
        for _ in range(ITERATIONS):
            every = [*(task for _, task in tasks), posture]
            speed = mink.solve_ik(configuration, every, 1 / float(fps), "daqp", damping=1e-3, limits=limits)
            configuration.integrate_inplace(speed, 1 / float(fps))
        found.append(configuration.q.copy())
    rows = torch.from_numpy(np.stack(found))
    base = rotations.to_matrix(rows[:, 3:7].roll(-1, dims=-1)) @ robot.zero[0].mT
    return RobotMotion(robot, fps, rows[:, :3], base, rows[:, 7:], seen.standing)


def measure(done: RobotMotion, seen: Observations, milliseconds: float) -> dict[str, float]:
    """Measure errors, cm, slides, cm/s, and jerk, rad/s^3."""
    at, world = done.chain_links()
    points = at[:, seen.links] + (world[:, seen.links] @ seen.points[..., None])[..., 0]
    missed = 100 * (points - seen.positions).norm(dim=-1)
    names = [done.robot.skeleton.names[link] for link in seen.links]
    hands = [
        names.index(done.robot.skeleton.names[done.robot.rigmap.joints[f"{side}Hand"]]) for side in ("left", "right")
    ]
    stays = done.contacts[1:] & done.contacts[:-1]
    speed = 100 * float(done.fps) * points[:, seen.tips].diff(dim=0).norm(dim=-1)[stays]
    jerk = done.angles.diff(n=3, dim=0).abs().mean() * float(done.fps) ** 3
    return {
        "feet, cm": float(missed[:, seen.tips].mean()),
        "hands, cm": float(missed[:, hands].mean()),
        "standing tips, cm/s": float(speed.mean()) if len(speed) else 0.0,
        "fastest, cm/s": float(speed.max()) if len(speed) else 0.0,
        "jerk, rad/s^3": float(jerk),
        "a frame, ms": milliseconds,
    }


def main(words: list[str] | None = None) -> None:
    """Measure and print."""
    given = parse(__doc__, words, count=10, model="", seconds=10.0, robot="g1.xml")
    robot, circles, rows = model.load(given.robot), load_circles(given, shortest=2.0, longest=given.seconds), []
    for circle in circles:
        found: dict[str, list[Mapping[str, float]]] = {"mink, each frame": [], "mapctl": []}
        for clip in circle.clips:
            seen = observe(retarget_motion(clip.motion, robot.character).motion, robot)
            for method, rows_of in found.items():
                began = perf_counter()
                alone = method.startswith("mink")
                done = solve_frames(robot, seen, clip.motion.fps) if alone else retarget_to_robot(clip.motion, robot)[0]
                rows_of.append(measure(done, seen, 1000 * (perf_counter() - began) / clip.motion.num_frames))
        for method, measured in found.items():
            means = {name: sum(row[name] for row in measured) / len(measured) for name in measured[0]}
            worst = {f"worst {name}": max(row[name] for row in measured) for name in ("feet, cm", "hands, cm")}
            rows.append({"clips of": circle.name, "method": method, **means, **worst})
    print_table(rows, circles)


if __name__ == "__main__":
    main()
