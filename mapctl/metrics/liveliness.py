"""How alive motion between keys is: how fast joints move, how far poses spread, how they jerk, as sums beside mocap's.

Ratios are of sums over many gaps: a mean of ratios is filled by those who stand still.
"""

from dataclasses import dataclass, fields

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mapctl import rotations
from mapctl.kinematics import heading_of_matrix
from mapctl.motion import Motion

_UNIT = 100.0  # cm


@dataclass(frozen=True)
class Liveliness:
    """Sums over frames and joints of the body seen from its hips along their heading."""

    count: float
    """Frames times joints that were summed over."""
    error: float
    """Distances from the true places, cm."""
    speed: float
    """Changes from frame to frame, cm."""
    spread: float
    """Distances from the mean pose, cm."""
    jerk: float
    """Third differences, cm."""

    def __add__(self, other: "Liveliness") -> "Liveliness":
        return Liveliness(*(getattr(self, one.name) + getattr(other, one.name) for one in fields(self)))


NOTHING = Liveliness(0.0, 0.0, 0.0, 0.0, 0.0)
"""To begin a sum with."""


def see_from_hips(
    places: Float[Tensor, "*batch frames joints 3"], hips_world_matrix: Float[Tensor, "*batch frames 3 3"]
) -> Float[Tensor, "*batch frames joints 3"]:
    """Return joint places from the hips along the hips' heading, metres."""
    return rotations.rotate_about_y(places - places[..., :1, :], -heading_of_matrix(hips_world_matrix)[..., None])


def measure_path_length(motion: Motion) -> float:
    """Measure the length of the joints' paths as seen from the hips, mean over joints, metres."""
    seen = see_from_hips(motion.joint_positions(), rotations.to_matrix(motion.local_quat_xyzw[:, 0]))
    return float(seen.diff(dim=0).norm(dim=-1).sum(dim=0).mean())


def measure_liveliness(
    seen: Float[Tensor, "frames joints 3"], true: Float[Tensor, "frames joints 3"], inside: Bool[Tensor, " frames"]
) -> Liveliness:
    """Measure one motion as `see_from_hips` returns it beside the true one, in the frames inside the gap; differences
    take in the keys around it."""
    joints = seen.shape[1]
    error = ((seen - true).norm(dim=-1) * inside[:, None]).sum()
    within = seen[inside]
    spread = (within - within.mean(dim=0)).norm(dim=-1).sum()
    sums = []
    for order in (1, 3):
        change = torch.diff(seen, n=order, dim=0).norm(dim=-1)
        near = inside.float().unfold(0, order + 1, 1).amax(dim=-1)
        sums.append((change * near[:, None]).sum())
    speed, jerk = sums
    found = (_UNIT * float(each) for each in (error, speed, spread, jerk))
    return Liveliness(float(inside.sum()) * joints, *found)
