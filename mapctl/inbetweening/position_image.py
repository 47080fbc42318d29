"""Position images: a motion with gaps as joint positions by frame (Kaufmann et al. 2020, section 3.1).

In the paper every frame is relative to its own root, whose trajectory is given by its velocities. In a gap the root is
not known, and the integral of proposed velocities does not end where the motion goes on. So positions here are relative
to a reference that is the root where it is known and an interpolation where it is not (linear from one known root to
the next): the proposal fits both ends.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mapctl import contacts, rotations
from mapctl.features import PRIOR_FPS
from mapctl.inbetweening.missing import blend_seams
from mapctl.inbetweening.query import GapQuery, Proposal
from mapctl.kinematics import heading, inverse
from mapctl.numerics import gaussian
from mapctl.numerics.intervals import last_observed, next_observed
from mapctl.skeleton import CANONICAL, LIMBS, TOE_JOINTS

_PARTNERS = CANONICAL.mirror_partners()


@dataclass(frozen=True, eq=False)
class PositionImage:
    """A batch of motions of one length, on canonical joints at the prior's rate. Joint 0 is the hips."""

    positions: Float[Tensor, "batch frames joints 3"]
    """Positions relative to the reference, metres; unknown ones are interpolated by slerp of the joints' rotations."""
    contacts: Float[Tensor, "batch frames 2"]
    """Left and right toe planted, 0 or 1; 0.5 where the toe is not known."""
    known_axes: Bool[Tensor, "batch frames joints 3"]
    """Which coordinates of a joint's position are known, in the reference's axes; drawings tell two of them."""
    ground: Float[Tensor, "batch frames 2"]
    """Position of the reference (x, z), world, metres."""
    heading: Float[Tensor, "batch frames"]
    """Heading of the reference about +Y, radians."""

    @staticmethod
    def of_world(
        positions_world: Float[Tensor, "batch frames joints 3"],
        heading: Float[Tensor, "batch frames"],
        contacts: Float[Tensor, "batch frames 2"],
        *,
        known: Bool[Tensor, "batch frames joints"],
        known_axes: Bool[Tensor, "batch frames joints 3"] | None = None,
    ) -> "PositionImage":
        """Build an image from world positions (metres) and the hips' heading (radians), interpolated where they are not
        known; the reference is their root. Contacts of toes that are not known may be anything finite. Where single
        coordinates are known they are given by `known_axes`, beside the joints that are `known` whole."""
        axes = known[..., None].expand(*known.shape, 3)
        if known_axes is not None:
            axes = axes | known_axes
        bits = torch.where(known[..., list(TOE_JOINTS)], contacts, 0.5)
        ground, facing = positions_world[..., 0, ::2], rotations.unwrap_angle(heading)
        image = PositionImage(positions_world, bits, axes, ground, facing)
        return replace(image, positions=image.from_world(positions_world))

    def from_world(
        self, positions_world: Float[Tensor, "batch frames joints 3"]
    ) -> Float[Tensor, "batch frames joints 3"]:
        """Transform world positions to the reference, metres."""
        offset = rotations.lift_ground(self.ground)[..., None, :]
        return rotations.rotate_about_y(positions_world - offset, -self.heading[..., None])

    def to_world(self, positions: Float[Tensor, "batch frames joints 3"]) -> Float[Tensor, "batch frames joints 3"]:
        """Transform positions relative to the reference to the world, metres."""
        offset = rotations.lift_ground(self.ground)[..., None, :]
        return rotations.rotate_about_y(positions, self.heading[..., None]) + offset

    def mirrored(self) -> "PositionImage":
        """Exchange left and right."""
        flip = self.ground.new_tensor([-1.0, 1.0])
        return PositionImage(
            mirror_positions(self.positions),
            self.contacts.flip(-1),
            self.known_axes[..., _PARTNERS, :],
            self.ground * flip,
            -self.heading,
        )

    def extended(self, frames: int) -> "PositionImage":
        """Return the image with so many frames before it and after it of which nothing is known; the reference stands
        still there."""
        known = torch.nn.functional.pad(self.known_axes, (0, 0, 0, 0, frames, frames))
        contacts = torch.nn.functional.pad(self.contacts, (0, 0, frames, frames), value=0.5)
        held = torch.arange(-frames, self.positions.shape[1] + frames, device=self.positions.device)
        held = held.clamp(0, self.positions.shape[1] - 1)
        positions, ground, heading = (each[:, held] for each in (self.positions, self.ground, self.heading))
        return PositionImage(positions, contacts, known, ground, heading)

    @property
    def known(self) -> Bool[Tensor, "batch frames joints"]:
        """Whether a joint's position is known, all of it."""
        return self.known_axes.all(dim=-1)

    def copy_nearest(self) -> tuple[Float[Tensor, "batch frames joints 3"], Float[Tensor, "batch frames joints 3"]]:
        """Copy every coordinate from the nearest frame in which it is known, and return how many frames away that is:
        the dense input of Zhou et al. 2020, section 3.5. Coordinates that are never known are 0, infinitely far."""
        known = self.known_axes.flatten(2).transpose(1, 2).flatten(0, 1)  # one row for each coordinate of each motion
        values = self.positions.flatten(2).transpose(1, 2).flatten(0, 1)
        frame = torch.arange(values.shape[1], device=values.device)
        before, after = last_observed(known), next_observed(known)
        nearest = torch.where((frame - before).abs() <= (after - frame).abs(), before, after)
        never = ~known.any(dim=1, keepdim=True)
        copied = torch.where(never, 0.0, values.gather(1, nearest))
        away = torch.where(never, torch.inf, (frame - nearest).abs().to(values))
        batch, _, *shape = self.positions.shape
        copied, away = (each.unflatten(0, (batch, -1)).transpose(1, 2).unflatten(2, shape) for each in (copied, away))
        return copied, away


@dataclass(frozen=True, eq=False)
class ProposedPositions:
    """Positions that a network proposes for an image."""

    positions: Float[Tensor, "batch frames joints 3"]
    """Positions of all joints relative to the image's reference, metres. Bone lengths are not exact."""
    contacts: Float[Tensor, "batch frames 2"]
    """Contact logits of the left and the right toe."""


def mirror_positions(positions: Float[Tensor, "*batch joints 3"]) -> Float[Tensor, "*batch joints 3"]:
    """Mirror positions through the reference's sagittal plane."""
    return positions[..., _PARTNERS, :] * positions.new_tensor([-1.0, 1.0, 1.0])


_JITTER_SIGMA, _POWER_SIGMA = 0.8, 10  # frames at the prior's rate
_MIN_CHANGE = 0.005  # metres
_SWAY_SIGMA, _DRIFT_PASSES = 10, 4  # frames at the prior's rate: slower than a step
_MIN_SWING_SPEED = 0.5  # m/s from which a proposed toe swings, whatever its logit: held, it would jerk the leg


def propose_from_positions(
    query: GapQuery, complete: Callable[[PositionImage], ProposedPositions], source: str
) -> Proposal:
    """Propose the motion on rigid bones nearest to the positions that `complete` proposes.

    Where the query keeps its trajectory, the hips follow it but for their sway. Effector targets are ignored.
    """
    shown, missing = query.motion, query.missing
    body = query.to_unit_size(shown)
    positions, facing = body.joint_positions(), heading(shown.local_quat_xyzw[:, 0])
    planted = contacts.detect_contacts(positions[:, list(TOE_JOINTS)], PRIOR_FPS)
    image = PositionImage.of_world(
        positions.float()[None], facing.float()[None], planted.float()[None], known=query.known_positions[None]
    )
    answer = complete(image)
    wanted = image.to_world(_remove_jitter(answer.positions, image))[0].double()
    if query.keep_trajectory:
        wanted = wanted - _estimate_root_drift(wanted[:, 0] - body.root_position, missing.root)[:, None]
    root = torch.where(missing.root[:, None], wanted[:, 0], body.root_position)
    # Limbs that are known in no frame bend as proposed.
    limbs = [
        replace(limb, shown=not bool(missing.joints[:, [limb.upper, limb.lower]].any(dim=1).all()))
        for limb in LIMBS.values()
    ]
    quats = inverse.solve_inverse_kinematics(
        wanted, shown.local_quat_xyzw, CANONICAL, free=missing.joints, root_position=root, limbs=limbs
    )
    quats = torch.where(missing.joints[..., None], quats, shown.local_quat_xyzw)
    motion = blend_seams(replace(shown, root_position=root * query.scale, local_quat_xyzw=quats), missing)
    toes = motion.joint_positions()[:, list(TOE_JOINTS)][..., ::2]
    speeds = torch.diff(toes, dim=0, prepend=toes[:1]).norm(dim=-1) * float(motion.fps)
    slow = speeds < _MIN_SWING_SPEED * query.scale
    logits = torch.where(slow, answer.contacts[0], -contacts.CERTAIN_LOGIT)
    known = image.known[0][:, list(TOE_JOINTS)]
    return Proposal(motion, torch.where(known, contacts.to_logits(planted), logits), source)


def _remove_jitter(positions: Float[Tensor, "1 frames joints 3"], image: PositionImage) -> Tensor:
    """Smooth a network's changes over about a frame, since the errors of its frames are independent. Where the changes
    are tiny they are jitter, and fade to the interpolation; known positions stay."""
    change = (positions - image.positions)[0]
    smooth = gaussian.smooth(change, _JITTER_SIGMA, side=3)
    power = gaussian.smooth(smooth.square().sum(dim=-1), _POWER_SIGMA)
    smooth = smooth * (power / (power + _MIN_CHANGE**2))[..., None]
    return torch.where(image.known[..., None], positions, image.positions + smooth)


def _estimate_root_drift(
    offset: Float[Tensor, "frames 3"], missing: Bool[Tensor, " frames"]
) -> Float[Tensor, "frames 3"]:
    """Estimate the drift of the hips over the ground, without their sway; none where they are known."""
    offset = torch.where(missing[:, None], offset, 0.0) * torch.tensor([1.0, 0.0, 1.0], dtype=offset.dtype)
    slow = torch.zeros_like(offset)
    for _ in range(_DRIFT_PASSES):  # each takes the slow part of the remainder
        rest = gaussian.smooth(offset - slow, _SWAY_SIGMA, side=4 * _SWAY_SIGMA)
        slow = slow + torch.where(missing[:, None], rest, 0.0)
    return slow
