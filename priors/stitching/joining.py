"""Two sides joined to one transition: their overlap blended, and what they disagree on in place spread over all of it.

Ren et al. 2024, section 3.2, blend the overlap alone. Ten centimetres between two sides blended over eight frames would
slide both feet; spread over the whole way they are a slightly longer or shorter walk. `Sides.spread` tells whether.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mapctl import rotations
from mapctl.features import LAYOUT
from mapctl.pose import BodyPose
from priors.stitching.sides import Sides


@dataclass(frozen=True, eq=False)
class Joined:
    """The frames between two poses, seen from the first."""

    root_position: Float[Tensor, "batch frames 3"]
    """Of the hips, metres."""
    quats: Float[Tensor, "batch frames joints 4"]
    """Local rotations."""
    contacts: Float[Tensor, "batch frames 2"]
    """Logits of planted toes."""
    apart: Float[Tensor, " batch"]
    """Mean distance of the two sides' joints in the middle of their overlap before they are joined, metres (MMPE)."""

    @property
    def finite(self) -> Bool[Tensor, " batch"]:
        """Whether all numbers of a motion are finite."""
        return self.root_position.isfinite().flatten(1).all(dim=1) & self.quats.isfinite().flatten(1).all(dim=1)

    def row(self, number: int) -> "Joined":
        """Return one motion, as a batch of one."""
        part = slice(number, number + 1)
        return Joined(self.root_position[part], self.quats[part], self.contacts[part], self.apart[part])


def join_sides(sides: Sides) -> Joined:
    """Join the sides of a transition of two frames or more."""
    between, made = sides.frames - 1, sides.features.shape[2]
    first, last = sides.overlap
    if first > last:
        raise ValueError("sides that have no frame in common cannot be joined")
    bodies = [_place_body(sides, side) for side in (0, 1)]
    seam = (first + last) // 2
    index = [seam - 1, between - seam]  # the same frame, as each side counts
    pairs = [body.slice(at, at + 1) for body, at in zip(bodies, index, strict=True)]
    apart = (pairs[0].joints_world() - pairs[1].joints_world()).norm(dim=-1).mean(dim=(1, 2))
    miss = (pairs[1].root_position - pairs[0].root_position)[:, 0, ::2]
    twist = rotations.wrap_angle(pairs[1].heading - pairs[0].heading)[:, 0]
    rows = []
    for side, body in enumerate(bodies):
        frame = torch.arange(1, made + 1) if side == 0 else torch.arange(made, 0, -1)
        share = _ease((frame / (sides.frames / 2)).clamp_max(1)) * (0.5 if side == 0 else -0.5) * sides.spread
        order = slice(None) if side == 0 else torch.arange(made - 1, -1, -1)
        root, quats = body.root_position[:, order], body.local_quat_xyzw[:, order]
        heading = rotations.about_y(share * twist[:, None])
        hips = rotations.multiply(heading, quats[..., 0, :])
        offset = rotations.lift_ground(share[:, None] * miss[:, None])
        quats = torch.cat([hips[..., None, :], quats[..., 1:, :]], dim=-2)
        rows.append((root + offset, quats, sides.logits[side][:, order]))
    root, quats, logits = (_blend(one, other, between, first, last) for one, other in zip(*rows, strict=True))
    return Joined(root, quats, logits, apart)


def _place_body(sides: Sides, side: int) -> BodyPose:
    """The poses of a side in the world of the first end, in its own order."""
    features, ground = sides.features[side], sides.place[side]
    height = LAYOUT.pick(features, "root_height")
    root = torch.cat([ground[..., :1], height, ground[..., 1:]], dim=-1)
    tilt, joints = LAYOUT.pick(features, "root_tilt"), LAYOUT.pick(features, "joint_rotations")
    return BodyPose(root, sides.heading[side], tilt, joints.unflatten(-1, (-1, 3)))


def _ease(share: Float[Tensor, " frames"]) -> Float[Tensor, " frames"]:
    """From 0 to 1 without a leap of speed at either end."""
    return share * share * (3 - 2 * share)


def _blend(one: Tensor, other: Tensor, between: int, first: int, last: int) -> Tensor:
    """Take the first side's frames up to the overlap, the second's after it, and a blend between that goes from one to
    the other evenly; quaternions on the shortest arc."""
    made = one.shape[1]
    count = last - first + 1
    share = torch.arange(1, count + 1, dtype=one.dtype) / (count + 1)
    a, b = one[:, first - 1 : last], other[:, :count]
    if one.ndim == 4:
        mixed = rotations.slerp(a, b, share[None, :, None].expand(a.shape[:-1]))
    else:
        mixed = torch.lerp(a, b, share[None, :, None])
    assert made + (made - count) == between
    return torch.cat([one[:, : first - 1], mixed, other[:, count:]], dim=1)
