"""Travel over the ground taken out of a motion, or put on a root joint above the hips.

Travel is the slow part of the root trajectory: a Gaussian takes sway and the rise and fall of speed with each
step out of it, and these stay with the hips. Of a loop it is the same share of the cycle's travel in every frame, so
that what is left repeats exactly.

Rigid transforms of the ground: a turn about the vertical, then a shift; and shares of one, as of a cycle's travel.

A position on the ground is the complex number z + ix, so that turning by an angle is multiplying by exp(i angle).
"""

import cmath
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from mapctl import rotations
from mapctl.editing.rigged_motion import RiggedMotion
from mapctl.formats import bvh
from mapctl.formats.character import add_root_to_character
from mapctl.motion import Motion
from mapctl.numerics import gaussian
from mapctl.retarget.reference_pose import UNROTATED
from mapctl.retarget.rigs import Rig
from mapctl.skeleton import Skeleton

_NO_TURN = 1e-9  # radians under which a transform is a shift alone


@dataclass(frozen=True)
class GroundTransform:
    """A turn about the vertical through the origin, then a shift over the ground."""

    turn: float
    """Turn, radians; positive turns +Z toward +X."""
    shift_xz: tuple[float, float]
    """Shift along x and z, metres."""

    @property
    def distance(self) -> float:
        """Length of the shift, metres."""
        return math.hypot(*self.shift_xz)

    def share(self, shares: Float[Tensor, " frames"]) -> tuple[Float[Tensor, " frames"], Float[Tensor, "frames 2"]]:
        """Return the turns (radians) and shifts (metres) of shares of this transform: 0 is none, 1 all of it.

        All are turns about the same point, or shifts along one line. Share a and then share b are share a + b.
        """
        if abs(self.turn) < _NO_TURN:
            return 0 * shares, shares[:, None] * shares.new_tensor(self.shift_xz)
        # (1 - exp(i s a)) / (1 - exp(i a)) without the loss of digits that small angles would bring.
        size = torch.sin(shares * self.turn / 2) / math.sin(self.turn / 2)
        x, z = self.shift_xz
        position = torch.polar(size.abs(), (shares - 1) * self.turn / 2) * size.sign() * complex(z, x)
        return shares * self.turn, torch.stack([position.imag, position.real], dim=-1)


def move_by_share(motion: Motion, transform: GroundTransform, shares: Float[Tensor, " frames"]) -> Motion:
    """Move each frame of a motion with Y up by a share of a transform: first turned about the origin, then shifted."""
    turns, shifts = transform.share(shares)
    local = motion.local_quat_xyzw.clone()
    local[:, 0] = rotations.multiply(rotations.about_y(turns), local[:, 0])
    position = rotations.rotate_about_y(motion.root_position, turns) + rotations.lift_ground(shifts)
    return replace(motion, root_position=position, local_quat_xyzw=rotations.make_sign_continuous(local))


def repeat_over_ground(motion: Motion, transform: GroundTransform, times: int) -> Motion:
    """Repeat a motion with Y up, each time moved on by the transform; the first one stays."""
    rounds = torch.arange(times, dtype=torch.float64).repeat_interleave(motion.num_frames)
    return move_by_share(motion.pick(torch.arange(motion.num_frames).repeat(times)), transform, rounds)


def fit_ground_transform(
    before: Float[Tensor, "*points 3"], after: Float[Tensor, "*points 3"], *, turning: bool = True
) -> GroundTransform:
    """Fit the transform that brings points nearest to others, by least squares; without `turning` a shift alone."""
    start, stop = (torch.complex(points[..., 2], points[..., 0]).flatten() for points in (before, after))
    product = ((start - start.mean()).conj() * (stop - stop.mean())).sum()
    turn = float(product.angle()) if turning else 0.0
    shift = complex(stop.mean().item()) - cmath.rect(1.0, turn) * complex(start.mean().item())
    return GroundTransform(turn, (shift.imag, shift.real))


_NAMES = ("root", "motion_root")


def set_root_track(
    motion: Motion, position: Float[Tensor, "frames 3"], turn_xyzw: Float[Tensor, "frames 4"], kept: Sequence[int]
) -> Motion:
    """Return a motion whose joint 0 has this position (metres) and rotation (xyzw). Those of its children that are
    `kept` stay where they are in the world, the others go with it."""
    positions, world = motion.joint_positions(), motion.joint_rotations()
    local, moving = motion.local_quat_xyzw.clone(), dict(motion.moving_offsets)
    local[:, 0], back = turn_xyzw, rotations.inverse(turn_xyzw)
    for child in kept:
        local[:, child] = rotations.multiply(back, world[:, child])
        moving[child] = rotations.rotate(back, positions[:, child] - position)
    return replace(
        motion,
        root_position=position,
        local_quat_xyzw=rotations.make_sign_continuous(local),
        moving_offsets=dict(sorted(moving.items())),
    )


def add_root(motion: Motion) -> Motion:
    """Return the same motion with a still joint above its first one, at the origin of the world; the file's layout, or
    its character (glTF, VRM), has it too."""
    old, frames = motion.skeleton, motion.num_frames
    name = next(name for name in (*_NAMES, *(f"root_{n}" for n in range(old.num_joints + 1))) if name not in old.names)
    offsets = torch.cat([old.offsets.new_zeros(1, 3), old.offsets])
    offsets[1] = motion.root_position[0]
    skeleton = Skeleton((name, *old.names), (-1, *(parent + 1 for parent in old.parents)), offsets, old.end_offsets)
    still = motion.local_quat_xyzw.new_tensor([0.0, 0.0, 0.0, 1.0]).expand(frames, 1, 4)
    moving = {joint + 1: track for joint, track in motion.moving_offsets.items()}
    return Motion(
        skeleton,
        motion.fps,
        torch.zeros_like(motion.root_position),
        torch.cat([still, motion.local_quat_xyzw], dim=1),
        {1: motion.root_position, **moving},
        bvh.add_root_to_layout(motion.source, name) or add_root_to_character(motion.source, name),
        motion.licence,
    )


_SLOW_SECONDS = 0.4  # standard deviation, seconds: of a sway of one a second 4 % is taken for travel


def remove_travel(motion: Motion, rig: Rig | None = None, cycle: GroundTransform | None = None) -> Motion:
    """Return a motion that stays in place: the hips stay about where they are in the first frame.

    Sway, bounce and heading stay. `cycle` is the travel of a loop: then its turning is taken out too and the loop
    repeats exactly. `rig` wins over what would be recognised; RequestError where the rig's joints cannot be identified.
    """
    rigged = RiggedMotion.of(motion, rig)
    if cycle is not None:
        shares = torch.arange(motion.num_frames, dtype=torch.float64) / motion.num_frames
        return rigged.with_motion(move_by_share(rigged.motion, cycle, -shares)).in_file_world(motion)
    position, _ = _find_travel(rigged)
    shift = rotations.lift_ground(position[0] - position)
    moved = replace(rigged.motion, root_position=rigged.motion.root_position + shift)
    return rigged.with_motion(moved).in_file_world(motion)


def move_travel_to_root(motion: Motion, rig: Rig | None = None, cycle: GroundTransform | None = None) -> Motion:
    """Return the same motion with its travel on the root joint: position on the ground and slow heading.

    The root is the joint above the hips where the rig has one; else a joint `root` is added there. No other joint moves
    in the world. `cycle` is the travel of a loop. `rig` wins over what would be recognised; RequestError where the
    rig's joints cannot be identified.
    """
    rigged = RiggedMotion.of(motion, rig)
    position, heading = _find_travel(rigged, cycle)
    rooted, like, rest = rigged.motion, motion, rigged.rigmap.rest_quat_xyzw[0]
    if rigged.hips == 0:
        up = rigged.rigmap.upright_quat_xyzw
        rooted, like, rest = add_root(rooted), add_root(motion), UNROTATED if up is None else up
    turn = rotations.multiply(rotations.about_y(heading), rest)
    put = set_root_track(rooted, rotations.lift_ground(position), turn, rooted.skeleton.children(0))
    return rigged.with_motion(put).in_file_world(like)


def _find_travel(
    rigged: RiggedMotion, cycle: GroundTransform | None = None
) -> tuple[Float[Tensor, "frames 2"], Float[Tensor, " frames"]]:
    """Find the travel of a motion, or of a loop: positions over the ground, metres, and headings, not wrapped."""
    hips = rigged.position("hips")[:, ::2]
    heading = rotations.unwrap_angle(rotations.split_heading(rigged.canonical.joint_rotations()[:, 0])[0])
    if cycle is None:
        both, sigma = torch.cat([hips, heading[:, None]], dim=-1), _SLOW_SECONDS * float(rigged.motion.fps)
        if len(both) > 1:  # beyond its ends a motion goes on as it came: the steps that led there come back
            side, ends = max(1, round(4 * sigma)), []
            for values in (both.flip(0), both):
                steps = values.diff(dim=0)
                around = torch.cat([steps.flip(0), steps]).repeat(-(-side // (2 * len(steps))), 1)
                ends.append(values[-1] + around[:side].cumsum(dim=0))
            padded = torch.cat([ends[0].flip(0), both, ends[1]])
            both = gaussian.smooth(padded, sigma, side=side)[side:-side]
        return both[:, :2], both[:, 2]
    shares = torch.arange(len(hips), dtype=torch.float64) / len(hips)
    turns, shifts = cycle.share(shares)
    back, away = cycle.share(-shares)
    middle = (rotations.rotate_ground(hips, back) + away).mean(dim=0)
    return rotations.rotate_ground(middle.expand_as(hips), turns) + shifts, (heading - turns).mean() + turns
