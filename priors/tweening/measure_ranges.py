"""Joint ranges over a folder of mocap: `python -m priors.tweening.measure_ranges --data DATA --out TABLE.json`.

It writes what `mapctl.joint_ranges` reads. For every joint it takes the order of Euler angles whose middle one stays
farthest from a right angle over all clips, where it would be gimbal lock; about another mid pose than the T-pose where
no order is good enough. The bounds are percentiles of the clips that training sees, with a margin, or the anatomy of
Zhou et al. 2020, table 6, where that is wider.
"""

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import permutations
from pathlib import Path
from typing import Any

import torch
import tyro
from jaxtyping import Float
from torch import Tensor

from mapctl import kinematics, rotations
from mapctl.features import LAYOUT
from mapctl.formats.atomic import write_text
from mapctl.joint_ranges import JointRange, JointRanges
from mapctl.skeleton import CANONICAL, mirror_name
from priors.training.corpus import Corpus, read_corpus, split_corpus

MAX_MIDDLE_DEG = 75.0
"""Degrees under which the middle angle of every joint stays over all data."""
_MARGIN_DEG, _HINGE_MARGIN_DEG = 10.0, 1.0  # degrees beyond the percentiles, of free angles and of a hinge's others
_TAIL = 0.001  # share of frames beyond each percentile
_MAX_BOUND_DEG = 85.0  # degrees of a middle angle's bound: no output of a network comes nearer to gimbal lock
_DIRECTIONS = 4000  # candidates for an axis of a mid pose
_GRID = 50  # steps of a unit in which directions that occur are told apart
_MIRROR = (1.0, -1.0, -1.0)  # of a rotation vector

Bounds = dict[str, tuple[float, float]]


@dataclass(frozen=True)
class Anatomy:
    """What a body can do, in canonical frames: left side, T-pose, degrees about X, Y and Z."""

    bounds: Bounds
    """By axis. Axes whose sign the table leaves open have the part that both signs share; full turns are left out."""
    free: str = "XYZ"
    """Axes about which the joint turns: about others the margin is small, hinges stay hinges."""


_TRUNK = Anatomy({"X": (-45, 45), "Y": (-45, 45), "Z": (-30, 30)})
_NECK = Anatomy({"X": (-37, 22), "Y": (-45, 45), "Z": (-30, 30)})
ANATOMY = {
    "spine": Anatomy({**_TRUNK.bounds, "X": (-45, 68)}),
    "chest": _TRUNK,
    "neck": _NECK,
    "head": _NECK,
    "leftShoulder": Anatomy({"X": (-10, 10), "Y": (-30, 30), "Z": (-30, 30)}),
    "leftLowerArm": Anatomy({"Y": (-150, 0), "X": (-30, 120)}, free="YX"),
    "leftHand": Anatomy({"Y": (-20, 20), "Z": (-90, 90)}),
    "leftUpperLeg": Anatomy({"Y": (-60, 60)}),
    "leftLowerLeg": Anatomy({"X": (0, 170)}, free="X"),
    "leftFoot": Anatomy({"X": (-31, 63), "Y": (-30, 30), "Z": (-20, 20)}),
    "leftToes": Anatomy({}, free="X"),
}
"""Zhou et al. 2020, table 6, whose frames have their Z along the child bone: abdomen, chest, neck, head, collar,
forearm, hand, thigh, shin and foot."""
_BENDING = {"leftLowerArm": "Y", "leftLowerLeg": "X"}
"""Axes about which joints bend one way: no data takes them farther than the margin beyond their anatomy."""


def main(data: Path, out: Path, *, seed: int = 1, cache: Path | None = None) -> None:
    """Measure ranges.

    Args:
        data: Folder of .bvh files, searched below.
        out: Where the table goes.
        seed: Of the split into clips that training sees and others.
        cache: Folder for the clips as features, which take minutes to read; beside `out` if not given.
    """
    corpus = read_corpus(data, match="", cache=cache or out.parent / "cache", skip_first=True)
    write_text(out, json.dumps(measure(corpus, seed=seed), indent=1) + "\n")


def measure(corpus: Corpus, *, seed: int) -> dict[str, Any]:
    """Measure the ranges of all clips; orders and mid poses over all of them, bounds over those of training."""
    every, train = corpus.features, split_corpus(corpus, seed).train.features
    ranges = {
        name: measure_joint(name, _pool_sides(every, name), _pool_sides(train, name))
        for name in CANONICAL.names[1:]
        if not name.startswith("right")
    }
    return {
        "command": f"python -m priors.tweening.measure_ranges --data DATA --out TABLE.json --seed {seed}",
        "data": corpus.identity(),
        "joints": {name: _format(one) for name, one in ranges.items()},
        "measured": measure_fit(JointRanges.of_joints(ranges), every),
    }


def measure_joint(name: str, every: Float[Tensor, "all_frames 3 3"], train: Float[Tensor, "frames 3 3"]) -> JointRange:
    """Measure one joint of the left side or the middle, from the rotations of both sides."""
    mid = torch.eye(3)
    order, largest = _choose_order(every)
    if largest > MAX_MIDDLE_DEG:
        order, mid = _choose_mid_pose(every)
    angles = torch.rad2deg(rotations.to_euler(mid.T @ train, rotations.euler_axes([order])))
    # About another pose than the table's the angles are not the table's.
    anatomy = ANATOMY.get(name, Anatomy({})) if largest <= MAX_MIDDLE_DEG else Anatomy({})
    bounds = [
        _bound(angles[:, at], anatomy, axis=axis, hinge=axis == _BENDING.get(name), middle=at == 1)
        for at, axis in enumerate(order)
    ]
    low, high = ([round(bound[end], 2) for bound in bounds] for end in (0, 1))
    quat = [round(value, 6) for value in rotations.from_matrix(mid.double()).tolist()]
    return JointRange(order, tuple(quat), tuple(low), tuple(high))


def measure_fit(ranges: JointRanges, features: Float[Tensor, "frames size"]) -> dict[str, float]:
    """Measure the largest middle angle (degrees), the share of joint frames outside the ranges (percent), and how far
    the nearest poses within are from the mocap's (joints' distances, cm, mean)."""
    vectors = LAYOUT.pick(features, "joint_rotations").unflatten(-1, (-1, 3))
    largest, beyond, apart = 0.0, 0, 0.0
    for part in vectors.split(20_000):
        local = rotations.rotation_vector_to_matrix(part)
        angles = ranges.to_angles(local)
        largest = max(largest, math.degrees(float(angles[..., 1].abs().max())))
        beyond += int((ranges.find_excess(angles) > 0).any(dim=-1).sum())
        within = ranges.to_matrices(torch.minimum(torch.maximum(angles, ranges.low.to(angles)), ranges.high.to(angles)))
        apart += float(_place(local).sub(_place(within)).norm(dim=-1).mean(dim=-1).sum())
    frames = len(features)
    return {
        "largest_middle_deg": round(largest, 2),
        "outside_percent": round(100 * beyond / (frames * vectors.shape[1]), 4),
        "nearest_pose_cm": round(100 * apart / frames, 4),
    }


def _place(local: Float[Tensor, "frames others 3 3"]) -> Float[Tensor, "frames joints 3"]:
    """Place all joints with the hips upright at the origin, metres."""
    hips = torch.eye(3).expand(len(local), 1, 3, 3)
    return kinematics.positions_from_matrices(CANONICAL, torch.cat([hips, local], dim=1))


def _pool_sides(features: Float[Tensor, "frames size"], name: str) -> Float[Tensor, "both 3 3"]:
    """Return a joint's rotations and the mirror images of its partner's, which is itself in the middle of the body."""
    vectors = LAYOUT.pick(features, "joint_rotations").unflatten(-1, (-1, 3))
    own, other = (CANONICAL.index(each) - 1 for each in (name, mirror_name(name)))
    both = torch.cat([vectors[:, own], vectors[:, other] * vectors.new_tensor(_MIRROR)])
    return rotations.rotation_vector_to_matrix(both)


def _choose_order(matrices: Float[Tensor, "frames 3 3"]) -> tuple[str, float]:
    """Choose the order whose middle angle is at most as large as any other's; also returns it, degrees."""
    found = []
    for order in map("".join, permutations("XYZ")):
        middle = rotations.to_euler(matrices, rotations.euler_axes([order]))[:, 1]
        found.append((math.degrees(float(middle.abs().max())), order))
    largest, order = min(found)
    return order, largest


def _choose_mid_pose(matrices: Float[Tensor, "frames 3 3"]) -> tuple[str, Float[Tensor, "3 3"]]:
    """Choose order and mid pose with the smallest largest middle angle.

    Its sine is the product of the mid pose's first axis with the rotation's last one: for each last axis a direction is
    sought that is as much across all of these as can be, and the mid pose is the shortest rotation that points the
    nearest of the other two axes there.
    """
    candidates = _spread_directions(_DIRECTIONS)
    found = []
    for last in range(3):
        occurring = torch.unique((_GRID * matrices[..., last]).round(), dim=0)
        cosines = (candidates @ torch.nn.functional.normalize(occurring, dim=-1).T).abs().amax(dim=1)
        found.append((float(cosines.min()), last, int(cosines.argmin())))
    _, last, best = min(found)
    firsts = [axis for axis in range(3) if axis != last]
    first = max(firsts, key=lambda axis: abs(float(candidates[best, axis])))
    # Either end of the direction will do.
    direction = candidates[best] * torch.sign(candidates[best, first])
    mid = rotations.to_matrix(rotations.between_vectors(torch.eye(3)[first], direction))
    return "".join("XYZ"[axis] for axis in (first, 3 - first - last, last)), mid


def _spread_directions(count: int) -> Float[Tensor, "count 3"]:
    """Spread directions evenly over the sphere, along a Fibonacci spiral."""
    number = torch.arange(count)
    height = 1 - (2 * number + 1) / count
    turn, radius = number * math.pi * (3 - math.sqrt(5)), (1 - height.square()).sqrt()
    return torch.stack([radius * turn.cos(), radius * turn.sin(), height], dim=-1)


def _bound(
    angles: Float[Tensor, " frames"], anatomy: Anatomy, *, axis: str, hinge: bool, middle: bool
) -> tuple[float, float]:
    """Bound one angle, degrees: percentiles and margin, or anatomy where that is wider."""
    low, high = _percentiles(angles)
    margin = _MARGIN_DEG if axis in anatomy.free else _HINGE_MARGIN_DEG
    low, high = low - margin, high + margin
    if axis in anatomy.bounds:
        least, most = anatomy.bounds[axis]
        low, high = min(low, least), max(high, most)
        if hinge:
            low, high = max(low, least - _MARGIN_DEG), min(high, most + _MARGIN_DEG)
    if middle:
        low, high = max(low, -_MAX_BOUND_DEG), min(high, _MAX_BOUND_DEG)
    return low, high


def _percentiles(angles: Float[Tensor, " frames"]) -> Sequence[float]:
    count = len(angles)
    tail = max(1, round(_TAIL * count))
    return float(angles.kthvalue(tail).values), float(angles.kthvalue(count + 1 - tail).values)


def _format(one: JointRange) -> dict[str, Any]:
    return {key: value if isinstance(value, str) else list(value) for key, value in vars(one).items()}


if __name__ == "__main__":
    tyro.cli(main)
