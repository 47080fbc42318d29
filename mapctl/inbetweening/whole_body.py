"""Whole-body inverse kinematics for single frames: hands and feet at target positions, with the rest of the body.

Limbs alone reach as far as they are long. For what lies beyond, the trunk leans, the shoulder girdle follows, the hips
sink on bending knees, and a moving body is a little further along. The smallest such change in sigmas is the mode of a
Gaussian over offsets of the pose, found by damped Gauss-Newton steps. Arms and legs then bend exactly, by their two
bones.
"""

import math
from collections.abc import Callable
from dataclasses import replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mapctl import rotations
from mapctl.inbetweening.effector_targets import EffectorTargets, bend_limb
from mapctl.kinematics import forward_kinematics
from mapctl.motion import Motion
from mapctl.skeleton import CANONICAL, LIMBS

_TRUNK_JOINTS = tuple(CANONICAL.index(name) for name in ("hips", "spine", "chest", "leftShoulder", "rightShoulder"))
_SIGMA_ROTATION = math.radians(12.0)
_SIGMA_LEAN = 0.08
"""Standard deviation of the hips' offset over feet that stay, metres."""
_SIGMA_REACH, _SIGMA_BALANCE = 0.004, 0.06  # metres
_IS_FOOT = torch.tensor([float(name.endswith("Foot")) for name in LIMBS])
_STRETCH_LIMIT = 0.985
"""Share of a limb's length beyond which its target pulls the body nearer: arms at one's sides are nearly straight."""
_FOLD_LIMIT = 0.3
"""Share of a limb's length below which its target pushes the body away."""
_SOFTPLUS_WIDTH = 0.015  # metres over which either sets in
_MAX_STEPS, _DAMPING, _TOLERANCE = 40, 0.1, 1e-3  # the last in sigmas of an offset
_DIFFERENCE_STEP = 1e-6  # metres and radians
_MASS_JOINTS, _MASSES = [CANONICAL.index(name) for name in ("head", "chest", "hips")], torch.tensor([0.1, 0.4, 0.5])
"""Parts of the body in its centre of mass, roughly, which has to stay over the feet (Winter 2009, table 4.1)."""
_UPPER, _ENDS = ([getattr(limb, end) for limb in LIMBS.values()] for end in ("upper", "end"))


def reach_targets(
    body: Motion,
    targets: EffectorTargets,
    *,
    turning: Bool[Tensor, "frames joints"],
    moving: Bool[Tensor, " frames"],
    stray: Float[Tensor, " frames"],
) -> Motion:
    """Solve for a canonical motion whose hands and feet reach their targets, in the frames that have one.

    `turning` are joints that may rotate and `moving` frames in which the hips may move; all else stays. `stray` is the
    standard deviation, metres, of a shift of the whole body, feet included, over the ground. Feet without a target keep
    their positions, but for that shift, and their orientations. Frames without a target stay to the bit; limbs point at
    a target out of reach.
    """
    frames = targets.wanted.any(dim=1).nonzero()[:, 0]
    if not len(frames):
        return body
    part = body.pick(frames)
    goals, wanted = targets.positions[frames], targets.wanted[frames]
    # Sigmas of shift (x, z), lean (x, y, z) and the rotations of the trunk; 0 for what may not move.
    step, lean = stray[frames].double()[:, None].expand(-1, 2), torch.full((len(frames), 3), _SIGMA_LEAN).double()
    turn = _SIGMA_ROTATION * turning[frames][:, _TRUNK_JOINTS].double().repeat_interleave(3, dim=1)
    sigma = torch.cat([torch.cat([step, lean], dim=1) * moving[frames, None], turn], dim=1)
    offsets = _minimise_offsets(part, goals[:, _ENDS], wanted[:, _ENDS], sigma)
    root, quats, shift = _apply_offsets(offsets, part.root_position, part.local_quat_xyzw)
    posed = replace(part, root_position=root, local_quat_xyzw=quats)
    before = part.joint_positions()
    ends = torch.where(wanted[..., None], goals, before + shift[:, None])
    bent = bend_limbs(posed, part, ends, wanted, turning[frames])
    root, quats = body.root_position.clone(), body.local_quat_xyzw.clone()
    root[frames], quats[frames] = bent.root_position, bent.local_quat_xyzw
    return replace(body, root_position=root, local_quat_xyzw=quats)


def _minimise_offsets(
    part: Motion,
    goals: Float[Tensor, "poses limbs 3"],
    wanted: Bool[Tensor, "poses limbs"],
    sigma: Float[Tensor, "poses offsets"],
) -> Float[Tensor, "poses offsets"]:
    """Find the mode of  |x / sigma|^2 + |r(x)|^2,  r the reach and balance residual; Levenberg-Marquardt in its small
    dual form, pose by pose: steps that do not help are damped more."""
    residual = _build_residual(part, goals, wanted.to(goals))
    unit, damping = torch.zeros_like(sigma), sigma.new_full((len(sigma), 1, 1), _DAMPING)
    now = residual(unit * sigma)
    cost = unit.square().sum(1) + now.square().sum(1)
    identity = torch.eye(now.shape[1], dtype=now.dtype)
    nearby = _DIFFERENCE_STEP * torch.eye(unit.shape[1], dtype=unit.dtype)[:, None]
    for _ in range(_MAX_STEPS):
        # By differences, all in one batch: in double precision good to six digits.
        shifted = residual((unit * sigma)[None] + nearby)
        jacobian = ((shifted - now) / _DIFFERENCE_STEP).permute(1, 2, 0) * sigma[:, None]
        # Woodbury: (1 + damping) I + J'J is inverted by way of the few residuals.
        gradient = unit + (jacobian.transpose(1, 2) @ now[..., None])[..., 0]
        firm = 1 + damping
        inner = torch.linalg.solve(
            firm * identity + jacobian @ jacobian.transpose(1, 2), jacobian @ gradient[..., None]
        )
        step = -(gradient - (jacobian.transpose(1, 2) @ inner)[..., 0]) / firm[..., 0]
        tried = residual((unit + step) * sigma)
        tried_cost = (unit + step).square().sum(1) + tried.square().sum(1)
        better = tried_cost < cost
        unit, now = torch.where(better[:, None], unit + step, unit), torch.where(better[:, None], tried, now)
        cost = torch.where(better, tried_cost, cost)
        damping = torch.where(better[:, None, None], damping / 4, damping * 4).clamp(1e-3, 1e6)
        if float(step.abs().max()) < _TOLERANCE:
            break
    return unit * sigma


def _build_residual(
    part: Motion, goals: Float[Tensor, "poses limbs 3"], wanted: Float[Tensor, "poses limbs"]
) -> Callable[[Tensor], Tensor]:
    """Build the residuals of poses by their offsets: by limb how much its target is too far and too near, then the
    offset of the centre of mass (x, z)."""
    skeleton, before = part.skeleton, part.joint_positions()
    lengths = skeleton.offsets.new_tensor([limb.length(skeleton) for limb in LIMBS.values()])
    limit, counts = _STRETCH_LIMIT * lengths, torch.maximum(wanted, _IS_FOOT)
    # A leg that was stretched before may stay so.
    was = (before[:, _ENDS] - before[:, _UPPER]).norm(dim=-1)
    allowed = (1 - wanted) * _soft_excess(was - limit)

    def residual(x: Float[Tensor, "*more poses offsets"]) -> Float[Tensor, "*more poses residuals"]:
        root, quats, shift = _apply_offsets(x, part.root_position, part.local_quat_xyzw)
        positions = forward_kinematics(skeleton.offsets.to(root), skeleton.parents, root, quats)[0]
        there = torch.where(wanted[..., None] > 0, goals, before[:, _ENDS] + shift[..., None, :])
        far = (there - positions[..., _UPPER, :]).norm(dim=-1)
        over = _soft_excess(far - limit) - allowed
        near = counts * wanted * _soft_excess(_FOLD_LIMIT * lengths - far)
        weight = ((positions - before)[..., _MASS_JOINTS, :] * _MASSES[:, None]).sum(dim=-2) - shift
        return torch.cat([counts * over / _SIGMA_REACH, near / _SIGMA_REACH, weight[..., ::2] / _SIGMA_BALANCE], dim=-1)

    return residual


def _soft_excess(value: Tensor) -> Tensor:
    return _SOFTPLUS_WIDTH * torch.nn.functional.softplus(value / _SOFTPLUS_WIDTH)


def _apply_offsets(
    x: Float[Tensor, "*more poses offsets"], root: Float[Tensor, "poses 3"], quats: Float[Tensor, "poses joints 4"]
) -> tuple[Tensor, Tensor, Float[Tensor, "*more poses 3"]]:
    """Apply offsets to root and rotations; also return the shift of the whole body, metres."""
    shift = torch.stack([x[..., 0], torch.zeros_like(x[..., 0]), x[..., 1]], dim=-1)
    turns = rotations.from_rotation_vector(x[..., 5:].unflatten(-1, (-1, 3)))
    quats = quats.expand(*x.shape[:-1], *quats.shape[-2:]).clone()
    quats[..., _TRUNK_JOINTS, :] = rotations.multiply(quats[..., _TRUNK_JOINTS, :], turns)
    return root + shift + x[..., 2:5], quats, shift


def bend_limbs(
    posed: Motion,
    before: Motion,
    ends: Float[Tensor, "poses joints 3"],
    wanted: Bool[Tensor, "poses joints"],
    turning: Bool[Tensor, "poses joints"],
) -> Motion:
    """Bend limbs so that feet, and hands with a target, are at `ends` (world, metres), as far as limbs reach.

    Feet, and arms without a target, keep their orientations of `before`; joints that are not `turning` stay.
    """
    orientations = before.joint_rotations()
    for name, limb in LIMBS.items():
        placed = wanted[:, limb.end] | name.endswith("Foot")
        # Under a trunk that leans, limbs keep their orientation: carried along, knees would end up behind.
        posed = _keep_orientation(posed, limb.upper, orientations[:, limb.upper], turning[:, limb.upper])
        if not bool(placed.any()):
            continue
        posed = bend_limb(posed, limb, ends[:, limb.end], placed & turning[:, [limb.upper, limb.lower]].all(dim=1))
        if name.endswith("Foot"):
            posed = _keep_orientation(posed, limb.end, orientations[:, limb.end], turning[:, limb.end])
    return posed


def _keep_orientation(
    motion: Motion, joint: int, orientation: Float[Tensor, "poses 4"], chosen: Bool[Tensor, " poses"]
) -> Motion:
    """Give a joint this orientation in the world, in the chosen poses."""
    above = motion.joint_rotations()[:, motion.skeleton.parents[joint]]
    local = rotations.multiply(rotations.inverse(above), orientation)
    quats = motion.local_quat_xyzw.clone()
    quats[:, joint] = torch.where(chosen[:, None], local, quats[:, joint])
    return replace(motion, local_quat_xyzw=quats)
