"""How far each joint of the canonical skeleton turns: Euler angles about a mid pose, in an order that keeps them away
from gimbal lock, and their bounds (Zhou et al. 2020, section 3.3 and table 6).

The bounds are measured over mocap, and widened to the anatomy of the paper's table where that is wider; `measured.json`
beside this file holds them with the command that wrote it.
"""

import json
from dataclasses import dataclass
from functools import cache
from importlib.resources import files

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from mapctl import rotations
from mapctl.errors import MapctlError
from mapctl.motion import Motion
from mapctl.skeleton import CANONICAL, mirror_name

TABLE = "measured.json"
"""File of the bundled ranges, beside this one."""
TOLERANCE_DEG = 0.5
"""Degrees beyond a bound that are no remark: less than readers of different rigs differ by."""
_MIRRORED_SIGN = {"X": 1.0, "Y": -1.0, "Z": -1.0}  # of a turn about an axis, seen in a mirror across the body


@dataclass(frozen=True, eq=False)
class JointRanges:
    """Ranges of all joints but the hips, which turn freely."""

    axes: Int[Tensor, "others 3"]
    """Axes of each joint's angles, as in `rotations.euler_axes`."""
    mid_matrix: Float[Tensor, "others 3 3"]
    """Rotations from which angles are measured: R = mid E(angles)."""
    low: Float[Tensor, "others 3"]
    """Least angles, radians."""
    high: Float[Tensor, "others 3"]
    """Greatest angles, radians."""

    def to_angles(self, local_matrix: Float[Tensor, "*batch others 3 3"]) -> Float[Tensor, "*batch others 3"]:
        """Return the angles of local rotations, radians."""
        return rotations.to_euler(self.mid_matrix.to(local_matrix).mT @ local_matrix, self.axes.to(local_matrix.device))

    def to_matrices(self, angles: Float[Tensor, "*batch others 3"]) -> Float[Tensor, "*batch others 3 3"]:
        """Invert `to_angles`."""
        return self.mid_matrix.to(angles) @ rotations.from_euler(angles, self.axes.to(angles.device))

    def constrain(self, free: Float[Tensor, "*batch others 3"]) -> Float[Tensor, "*batch others 3"]:
        """Map any numbers to angles within the ranges, radians: (b - a)/2 tanh(v) + (a + b)/2.

        Zhou et al. 2020, Eq. 3, print (a - b) for both, which does not lead to [a, b].
        """
        low, high = self.low.to(free), self.high.to(free)
        return (high - low) / 2 * torch.tanh(free) + (low + high) / 2

    def find_excess(self, angles: Float[Tensor, "*batch others 3"]) -> Float[Tensor, "*batch others 3"]:
        """Return by how much angles are beyond their ranges, radians; 0 within."""
        low, high = self.low.to(angles), self.high.to(angles)
        return (low - angles).clamp_min(0) + (angles - high).clamp_min(0)


@dataclass(frozen=True)
class OutOfRange:
    """A joint that turns beyond its range."""

    joint: str
    frame: int
    """Frame in which it is farthest beyond."""
    degrees: float
    """By how much it is beyond there."""


def outside(motion: Motion, *, known: Bool[Tensor, "frames joints"] | None = None) -> list[OutOfRange]:
    """List the joints of a canonical motion that turn beyond their ranges by more than TOLERANCE_DEG, the farthest
    first; those that are `known`, if that is given. MapctlError for other skeletons."""
    if motion.skeleton.names != CANONICAL.names:
        raise MapctlError("joint ranges are those of canonical joints; use retarget.to_canonical first")
    ranges = load()
    angles = ranges.to_angles(rotations.to_matrix(motion.local_quat_xyzw[:, 1:]))
    excess = torch.rad2deg(ranges.find_excess(angles)).amax(dim=-1)
    if known is not None:
        excess = torch.where(known[:, 1:], excess, 0.0)
    most, frames = excess.max(dim=0)
    found = map(OutOfRange, CANONICAL.names[1:], frames.tolist(), most.tolist())
    return sorted((one for one in found if one.degrees > TOLERANCE_DEG), key=lambda one: -one.degrees)


@cache
def load() -> JointRanges:
    """Return the bundled ranges; a joint on one side has those of its mirror image if it has none of its own."""
    rows = json.loads(files(__name__).joinpath(TABLE).read_text("utf-8"))["joints"]
    orders, mids, lows, highs = [], [], [], []
    for name in CANONICAL.names[1:]:
        row = rows.get(name) or rows[mirror_name(name)]
        bounds = list(zip(row["order"], row["low_deg"], row["high_deg"], strict=True))
        x, y, z, w = row["mid_quat_xyzw"]
        if name not in rows:
            bounds = [(axis, *sorted(_MIRRORED_SIGN[axis] * end for end in ends)) for axis, *ends in bounds]
            y, z = -y, -z
        orders.append(row["order"])
        mids.append((x, y, z, w))
        lows.append([low for _, low, _ in bounds])
        highs.append([high for *_, high in bounds])
    # Kept for every later call, while the first may be within another default device.
    with torch.device("cpu"):
        mid, low, high = (torch.tensor(values, dtype=torch.float64) for values in (mids, lows, highs))
        quats = torch.nn.functional.normalize(mid, dim=-1)
        axes = rotations.euler_axes(orders)
        return JointRanges(axes, rotations.to_matrix(quats), torch.deg2rad(low), torch.deg2rad(high))
