"""Travel over the ground taken out of a motion, or put on a root joint above the hips.

Travel is the slow part of the hips' way over the ground: a Gaussian takes sway and the rise and fall of speed with each
step out of it, and these stay with the hips. Of a loop it is the same share of the cycle's travel in every frame, so
that what is left repeats exactly.
"""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from mapctl import rotations
from mapctl.editing.ground_transform import GroundTransform, move_by_share
from mapctl.editing.rigged_motion import RiggedMotion
from mapctl.editing.root_joint import add_root, set_root_track
from mapctl.motion import Motion
from mapctl.numerics import gaussian
from mapctl.retarget.rigs import Rig

_SLOW_SECONDS = 0.4  # standard deviation, seconds: of a sway of one a second 4 % is taken for travel


@dataclass(frozen=True, eq=False)
class Travel:
    """Travel of the body over the ground, frame by frame."""

    position_xz: Float[Tensor, "frames 2"]
    """Position, metres."""
    heading: Float[Tensor, " frames"]
    """Heading, radians about +Y, not wrapped."""


def remove_travel(motion: Motion, rig: Rig | None = None, cycle: GroundTransform | None = None) -> Motion:
    """Return a motion that stays in place: the hips stay about where they are in the first frame.

    Sway, bounce and heading stay. `cycle` is the travel of a loop: then its turning is taken out too and the loop
    repeats exactly. `rig` wins over what would be recognised; RequestError where the rig's joints cannot be identified.
    """
    rigged = RiggedMotion.of(motion, rig)
    if cycle is not None:
        shares = torch.arange(motion.num_frames, dtype=torch.float64) / motion.num_frames
        return rigged.with_motion(move_by_share(rigged.motion, cycle, -shares)).in_file_world(motion)
    travel = find_travel(rigged)
    shift = rotations.lift_ground(travel.position_xz[0] - travel.position_xz)
    moved = replace(rigged.motion, root_position=rigged.motion.root_position + shift)
    return rigged.with_motion(moved).in_file_world(motion)


def move_travel_to_root(motion: Motion, rig: Rig | None = None, cycle: GroundTransform | None = None) -> Motion:
    """Return the same motion with its travel on the root joint: position on the ground and slow heading.

    The root is the joint above the hips where the rig has one; else a joint `root` is added there. No other joint moves
    in the world. `cycle` is the travel of a loop. `rig` wins over what would be recognised; RequestError where the
    rig's joints cannot be identified.
    """
    rigged = RiggedMotion.of(motion, rig)
    travel = find_travel(rigged, cycle)
    if rigged.hips == 0:
        up = rigged.rigmap.upright_quat_xyzw
        rest = rotations.about_y(torch.zeros(()).double()) if up is None else up
        put = _put_on_root(add_root(rigged.motion), travel, rest)
    else:
        put = _put_on_root(rigged.motion, travel, rigged.rigmap.rest_quat_xyzw[0])
    like = add_root(motion) if rigged.hips == 0 else motion
    return rigged.with_motion(put).in_file_world(like)


def find_travel(rigged: RiggedMotion, cycle: GroundTransform | None = None) -> Travel:
    """Find the travel of a motion, or of a loop with this travel by cycle."""
    hips = rigged.position("hips")[:, ::2]
    heading = rotations.unwrap_angle(rotations.split_heading(rigged.canonical.joint_rotations()[:, 0])[0])
    if cycle is None:
        both = _low_pass(torch.cat([hips, heading[:, None]], dim=-1), _SLOW_SECONDS * float(rigged.motion.fps))
        return Travel(both[:, :2], both[:, 2])
    shares = torch.arange(len(hips), dtype=torch.float64) / len(hips)
    turns, shifts = cycle.share(shares)
    back, away = cycle.share(-shares)
    middle = (rotations.rotate_ground(hips, back) + away).mean(dim=0)
    return Travel(rotations.rotate_ground(middle.expand_as(hips), turns) + shifts, (heading - turns).mean() + turns)


def _low_pass(values: Float[Tensor, "frames width"], sigma: float) -> Float[Tensor, "frames width"]:
    """Low-pass values by a Gaussian of `sigma` frames; beyond its ends a motion goes on as it came."""
    side = max(1, round(4 * sigma))
    if len(values) < 2:
        return values
    before, after = _extend(values.flip(0), side).flip(0), _extend(values, side)
    padded = torch.cat([before, values, after])
    return gaussian.convolve(padded, gaussian.kernel(max(sigma, 1e-6), side), "repeated")[side:-side]


def _extend(values: Float[Tensor, "frames width"], count: int) -> Float[Tensor, "count width"]:
    """Return frames after the last, in which the steps that led there come back, the last first."""
    steps = values.diff(dim=0)
    around = torch.cat([steps.flip(0), steps])
    times = -(-count // len(around))
    return values[-1] + around.repeat(times, 1)[:count].cumsum(dim=0)


def _put_on_root(motion: Motion, travel: Travel, rest_xyzw: Float[Tensor, "4"]) -> Motion:
    """Put travel on joint 0 of an upright motion; its children stay where they are in the world."""
    turn = rotations.multiply(rotations.about_y(travel.heading), rest_xyzw.expand(motion.num_frames, 4))
    return set_root_track(motion, rotations.lift_ground(travel.position_xz), turn, motion.skeleton.children(0))
