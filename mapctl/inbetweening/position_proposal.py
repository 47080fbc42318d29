"""Rigid bones from proposed joint positions: their jitter smoothed away, inverse kinematics, blended seams."""

from collections.abc import Callable
from dataclasses import replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mapctl import contacts
from mapctl.features import PRIOR_FPS
from mapctl.inbetweening.position_image import PositionImage, ProposedPositions
from mapctl.inbetweening.query import GapQuery, Proposal
from mapctl.inbetweening.seam_blending import blend_seams_in_positions, blend_seams_in_rotations
from mapctl.kinematics import heading, inverse
from mapctl.motion import Motion
from mapctl.numerics import gaussian
from mapctl.skeleton import CANONICAL, LIMBS, TOE_JOINTS, Limb

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
    planted = contacts.detect_contacts(body.joint_positions()[:, list(TOE_JOINTS)], PRIOR_FPS)
    image = make_position_image(query)
    answer = complete(image)
    wanted = image.to_world(_remove_jitter(answer.places, image))[0].double()
    if query.keep_trajectory:
        wanted = wanted - _estimate_root_drift(wanted[:, 0] - body.root_position, missing.root)[:, None]
    root = torch.where(missing.root[:, None], wanted[:, 0], body.root_position)
    limbs = _select_limbs(missing.joints)
    quats = inverse.solve_inverse_kinematics(
        wanted, shown.local_quat_xyzw, CANONICAL, free=missing.joints, root_position=root, limbs=limbs
    )
    quats = torch.where(missing.joints[..., None], quats, shown.local_quat_xyzw)
    quats = blend_seams_in_rotations(quats, missing.joints, fps=PRIOR_FPS)
    root = blend_seams_in_positions(root * query.scale, missing.root, fps=PRIOR_FPS)
    motion = replace(shown, root_position=root, local_quat_xyzw=quats)
    slow = _compute_toe_speeds(motion) < _MIN_SWING_SPEED * query.scale
    logits = torch.where(slow, answer.contacts[0], -contacts.CERTAIN_LOGIT)
    known = image.known[0][:, list(TOE_JOINTS)]
    return Proposal(motion, torch.where(known, contacts.to_logits(planted), logits), source)


def make_position_image(query: GapQuery) -> PositionImage:
    """Make the image of a query, of unit size, in a batch of one."""
    positions = query.to_unit_size(query.motion).joint_positions()
    planted = contacts.detect_contacts(positions[:, list(TOE_JOINTS)], PRIOR_FPS)
    return PositionImage.of_world(
        positions.float()[None],
        heading(query.motion.local_quat_xyzw[:, 0]).float()[None],
        planted.float()[None],
        known=query.known_positions[None],
        present=torch.ones(1, len(positions), dtype=torch.bool),
        toes=TOE_JOINTS,
    )


def _select_limbs(missing: Bool[Tensor, "frames joints"]) -> list[Limb]:
    """Return arms and legs; those known in no frame bend as proposed."""
    return [
        replace(limb, shown=not bool(missing[:, [limb.upper, limb.lower]].any(dim=1).all())) for limb in LIMBS.values()
    ]


def _remove_jitter(positions: Float[Tensor, "1 frames joints 3"], image: PositionImage) -> Tensor:
    """Smooth a network's changes over about a frame, since the errors of its frames are independent. Where the changes
    are tiny they are jitter, and fade to the interpolation; known positions stay.
    """
    change = (positions - image.places)[0]
    smooth = gaussian.convolve(change, gaussian.kernel(_JITTER_SIGMA, 3), "repeated")
    power = gaussian.convolve(smooth.square().sum(dim=-1), gaussian.kernel(_POWER_SIGMA, 3 * _POWER_SIGMA), "repeated")
    smooth = smooth * (power / (power + _MIN_CHANGE**2))[..., None]
    return torch.where(image.known[..., None], positions, image.places + smooth)


def _estimate_root_drift(
    offset: Float[Tensor, "frames 3"], missing: Bool[Tensor, " frames"]
) -> Float[Tensor, "frames 3"]:
    """Estimate the drift of the hips over the ground, without their sway; none where they are known."""
    offset = torch.where(missing[:, None], offset, 0.0) * torch.tensor([1.0, 0.0, 1.0], dtype=offset.dtype)
    slow, taps = torch.zeros_like(offset), gaussian.kernel(_SWAY_SIGMA, 4 * _SWAY_SIGMA)
    for _ in range(_DRIFT_PASSES):  # each takes the slow part of the remainder
        slow = slow + torch.where(missing[:, None], gaussian.convolve(offset - slow, taps, "repeated"), 0.0)
    return slow


def _compute_toe_speeds(motion: Motion) -> Float[Tensor, "frames 2"]:
    """Compute speeds of the toes over the ground, m/s."""
    toes = motion.joint_positions()[:, list(TOE_JOINTS)][..., ::2]
    return torch.diff(toes, dim=0, prepend=toes[:1]).norm(dim=-1) * float(motion.fps)
