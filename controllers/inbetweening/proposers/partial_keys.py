"""Proposals through partial keys, which give only positions of hands, feet or hips.

An in-betweener that was trained with partial keys makes its motion through them. Another that gets the position of one
hand in one frame meets it in that frame and ignores it in the frames beside: partial keys are hidden from it. It
proposes twice: first freely, from which the trajectory follows on which
the targets can be met; then along that trajectory. The error left at the key's frame is met by the smallest motion of
the whole body (see `mapctl.inbetweening.whole_body`), which goes there and back at a usual acceleration.
"""

import math
from dataclasses import replace

import scipy
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mapctl import rotations
from mapctl.inbetweening import GapQuery, Proposal
from mapctl.inbetweening.effector_targets import EffectorTargets
from mapctl.inbetweening.whole_body import bend_limbs, reach_targets
from mapctl.kinematics import heading
from mapctl.motion import Motion
from mapctl.numerics.intervals import last_observed, next_observed
from mapctl.numerics.smooth_offsets import interpolate_offsets, interpolate_turns
from mapctl.protocols import Inbetweener
from mapctl.skeleton import CANONICAL, LIMBS

_MIN_ROOT_UNCERTAINTY = 0.02  # metres, of the position of a standing body
_ROOT_UNCERTAINTY_SHARE = 0.4  # of the distance travelled since the last known position
_MIN_DIRECTION_SPEED = 0.2  # m/s from which a trajectory determines the facing
_STEP_SECONDS = 0.25
_STRETCH_SHARE = 0.985  # of a limb's length that it reaches
_MIN_LIMB_SECONDS, _LIMB_ACCELERATION = 0.15, 15.0
"""Least time in which a limb goes to its target, and its acceleration (m/s^2) beyond that: a sixth of what hands and
feet reach in walking."""
_MIN_TRUNK_SECONDS, _TRUNK_ACCELERATION = 0.25, 3.0
"""Least time and acceleration of hips and trunk."""
_ARMS = [
    joint
    for name, limb in LIMBS.items()
    if name.endswith("Hand")
    for joint in (CANONICAL.parents[limb.upper], limb.upper, limb.lower, limb.end)
]
_TRUNK = [joint for joint in range(CANONICAL.num_joints) if joint not in _ARMS]  # and legs
_FEET = tuple(limb.end for name, limb in LIMBS.items() if name.endswith("Foot"))


def propose_through_keys(
    query: GapQuery, inbetweener: Inbetweener, generator: torch.Generator | None
) -> tuple[Proposal, EffectorTargets | None]:
    """Propose a motion with hands and feet at their targets, and the hips at theirs in frames that give no more; also
    return the targets, moved within reach where they are not.
    """
    hips, targets, wanted = _find_partial_keys(query)
    if not bool((hips | wanted).any()):
        return inbetweener.propose(query, generator=generator), targets
    if inbetweener.takes_partial_keys:
        return _reach_exactly(query, inbetweener.propose(query, generator=generator), wanted)
    blind = guided = query.hide_partial_keys()
    if bool(query.missing.root.any()):
        first = inbetweener.rough.propose(blind, generator=generator).motion
        guided = _interpolate_trajectory(query, blind, first, targets, hips)
    answer = inbetweener.propose(replace(guided, effector_targets=_add_root_targets(query, hips)), generator=generator)
    return meet_partial_keys(query, answer)


def meet_partial_keys(query: GapQuery, answer: Proposal) -> tuple[Proposal, EffectorTargets | None]:
    """Bend a motion that does not meet partial keys until it does, going there and coming back as bodies do; also
    return the targets, moved within reach where they are not."""
    hips, targets, wanted = _find_partial_keys(query)
    if not bool((hips | wanted).any()):
        return answer, targets
    blind, made = query.hide_partial_keys(), answer.motion
    posed = _set_hips(made, query.motion, hips)
    if targets is None:
        return replace(answer, motion=_blend_key_poses(made, posed, hips, blind)), None
    turning, moving = query.missing.joints, query.missing.root
    stray = torch.full(hips.shape, _MIN_ROOT_UNCERTAINTY)
    posed = reach_targets(posed, targets, turning=turning, moving=moving, stray=stray)[0]
    reached = torch.where(targets.wanted[..., None], posed.joint_positions(), targets.places)
    there = replace(answer, motion=_blend_key_poses(made, posed, hips | wanted, blind))
    return there, EffectorTargets(reached, targets.wanted)


def _find_partial_keys(
    query: GapQuery,
) -> tuple[Bool[Tensor, " frames"], EffectorTargets | None, Bool[Tensor, " frames"]]:
    """Find the frames in which the hips alone are told, the effector targets, and the frames that have some."""
    hips, targets = query.root_only_keys, query.effector_targets
    return hips, targets, torch.zeros_like(hips) if targets is None else targets.wanted.any(dim=1)


def _reach_exactly(
    query: GapQuery, answer: Proposal, wanted: Bool[Tensor, " frames"]
) -> tuple[Proposal, EffectorTargets | None]:
    """Move a motion that was made through effector targets so that limbs reach them: the body where limbs alone do
    not, and no more than that, or it would leave where the network has it."""
    targets = query.effector_targets
    if targets is None:
        return answer, None
    far = wanted & _find_out_of_reach(answer.motion, targets)
    if not bool(far.any()):
        return answer, targets
    told, targets, wanted = targets, EffectorTargets(targets.places, targets.wanted & far[:, None]), far
    turning, moving = query.missing.joints, query.missing.root
    stray = torch.full(wanted.shape, _MIN_ROOT_UNCERTAINTY)
    posed = reach_targets(answer.motion, targets, turning=turning, moving=moving, stray=stray)[0]
    reached = torch.where(targets.wanted[..., None], posed.joint_positions(), targets.places)
    there = replace(answer, motion=_blend_key_poses(answer.motion, posed, wanted, query))
    return there, EffectorTargets(reached, told.wanted)


def _find_out_of_reach(motion: Motion, targets: EffectorTargets) -> Bool[Tensor, " frames"]:
    """Find the frames in which a target is farther away than its limb is long."""
    positions, far = motion.joint_positions(), torch.zeros(motion.num_frames, dtype=torch.bool)
    for limb in LIMBS.values():
        away = (targets.places[:, limb.end] - positions[:, limb.upper]).norm(dim=-1)
        far |= targets.wanted[:, limb.end] & (away > _STRETCH_SHARE * limb.length(motion.skeleton))
    return far


def _add_root_targets(query: GapQuery, hips: Bool[Tensor, " frames"]) -> EffectorTargets | None:
    """Join the effector targets and the positions of hips that are known alone."""
    targets = query.effector_targets
    if not bool(hips.any()):
        return targets
    positions = query.motion.joint_positions()
    wanted = torch.zeros(positions.shape[:2], dtype=torch.bool)
    wanted[hips, 0] = True
    if targets is None:
        return EffectorTargets(positions, wanted)
    positions = torch.where(targets.wanted[..., None], targets.places, positions)
    return EffectorTargets(positions, wanted | targets.wanted)


def _interpolate_trajectory(
    query: GapQuery, blind: GapQuery, body: Motion, targets: EffectorTargets | None, hips: Bool[Tensor, " frames"]
) -> GapQuery:
    """Return the query with its hips along a trajectory through all keys, and facing along it."""
    root, facing = body.root_position.clone(), rotations.unwrap_angle(heading(body.local_quat_xyzw[:, 0]))
    knots = ~blind.missing.root | hips
    root[knots] = query.motion.root_position[knots]
    own = heading(query.motion.local_quat_xyzw[:, 0])
    facing = torch.where(knots, facing + rotations.wrap_angle(own - facing), facing)
    if targets is not None:
        wanted = targets.wanted.any(dim=1) & blind.missing.root & ~hips
        turning, moving = blind.missing.joints, blind.missing.root
        stray = _estimate_root_uncertainty(body, moving)
        root = root + reach_targets(body, targets, turning=turning, moving=moving, stray=stray)[1]
        positions = _interpolate_knots(root, knots | wanted, query.seconds)
        facing = facing + torch.where(
            knots, 0.0, _compute_heading_change(body.root_position, positions, float(body.fps))
        )
        knots = knots | wanted
    positions = _interpolate_knots(root, knots, query.seconds)
    turned = _interpolate_knots(facing[:, None], knots, query.seconds)[:, 0]
    shown = query.motion
    quats = shown.local_quat_xyzw.clone()
    turn = torch.where(blind.missing.root, turned - heading(quats[:, 0]), 0.0)
    quats[:, 0] = rotations.multiply(rotations.about_y(turn), quats[:, 0])
    root = torch.where(blind.missing.root[:, None], positions, shown.root_position)
    return replace(blind, motion=replace(shown, root_position=root, local_quat_xyzw=quats), keep_trajectory=True)


def _estimate_root_uncertainty(body: Motion, missing: Bool[Tensor, " frames"]) -> Float[Tensor, " frames"]:
    """Estimate the uncertainty of proposed hips, metres: proportional to their speed and to the time from the nearest
    known frame.
    """
    known, frame, fps = ~missing[None], torch.arange(len(missing)), float(body.fps)
    before, after = last_observed(known)[0], next_observed(known)[0]
    seconds = torch.minimum((frame - before).abs(), (after - frame).abs()) / fps
    path_length = (body.root_position[after] - body.root_position[before])[:, ::2].norm(dim=-1)
    return _MIN_ROOT_UNCERTAINTY + _ROOT_UNCERTAINTY_SHARE * seconds * path_length * fps / (after - before).clamp_min(1)


def _interpolate_knots(
    values: Float[Tensor, "frames width"], knots: Bool[Tensor, " frames"], seconds: Float[Tensor, " frames"]
) -> Float[Tensor, "frames width"]:
    """Interpolate between values at knots by monotone cubics in time; constant beyond the first and the last."""
    if int(knots.sum()) < 2:
        return values
    # Linear beyond the ends: a monotone cubic's own estimate of its slope there is up to half too large.
    at, known = (torch.cat([2 * v[:1] - v[1:2], v, 2 * v[-1:] - v[-2:-1]]) for v in (seconds[knots], values[knots]))
    curve = scipy.interpolate.PchipInterpolator(at.numpy(), known.numpy())
    return torch.as_tensor(curve(seconds.clamp(at[1], at[-2]).numpy())).to(values)


def _compute_heading_change(
    before: Float[Tensor, "frames 3"], after: Float[Tensor, "frames 3"], fps: float
) -> Float[Tensor, " frames"]:
    """Compute the difference of two trajectories' directions, radians, weighted by speed: none where either stands."""
    one, speed = _compute_travel_direction(before[:, ::2], fps)
    other, other_speed = _compute_travel_direction(after[:, ::2], fps)
    weight = torch.minimum(speed, other_speed).square()
    return rotations.wrap_angle(other - one) * weight / (weight + _MIN_DIRECTION_SPEED**2)


def _compute_travel_direction(
    ground: Float[Tensor, "frames 2"], fps: float
) -> tuple[Float[Tensor, " frames"], Float[Tensor, " frames"]]:
    """Compute a trajectory's direction, radians, and speed, m/s, without the sway of single steps."""
    reach, frame = max(1, round(_STEP_SECONDS * fps)), torch.arange(len(ground))
    start, stop = (frame - reach).clamp_min(0), (frame + reach).clamp(max=len(ground) - 1)
    velocity = (ground[stop] - ground[start]) * fps / (stop - start).clamp_min(1)[:, None]
    return torch.atan2(velocity[:, 0], velocity[:, 1]), velocity.norm(dim=1)


def _set_hips(body: Motion, known: Motion, frames: Bool[Tensor, " frames"]) -> Motion:
    """Set the hips to those of `known` in these frames; the body takes their heading, and their children keep their
    tilt."""
    quats, root = body.local_quat_xyzw.clone(), body.root_position.clone()
    facing = heading(known.local_quat_xyzw[:, 0]) - heading(quats[:, 0])
    turned = rotations.multiply(rotations.about_y(facing), quats[:, 0])
    tilted = rotations.multiply(rotations.inverse(known.local_quat_xyzw[:, 0]), turned)
    for child in body.skeleton.children(0):
        quats[:, child] = torch.where(frames[:, None], rotations.multiply(tilted, quats[:, child]), quats[:, child])
    quats[frames, 0], root[frames] = known.local_quat_xyzw[frames, 0], known.root_position[frames]
    return replace(body, local_quat_xyzw=quats, root_position=root)


def _blend_key_poses(body: Motion, posed: Motion, keys: Bool[Tensor, " frames"], query: GapQuery) -> Motion:
    """Blend `body` to the poses `posed` in the frames of keys and back, feet staying on their own trajectories."""
    fps = float(body.fps)
    positions, goals = body.joint_positions(), posed.joint_positions()
    distance = torch.where(keys[:, None], (goals - positions).norm(dim=-1), 0.0)
    limb = _compute_duration(distance[:, [limb.end for limb in LIMBS.values()]], _MIN_LIMB_SECONDS, _LIMB_ACCELERATION)
    trunk = _compute_duration(distance[:, :1], _MIN_TRUNK_SECONDS, _TRUNK_ACCELERATION)
    known = ~query.missing.joints | keys[:, None]
    wanted_quats = torch.where(keys[:, None, None], posed.local_quat_xyzw, body.local_quat_xyzw)
    quats = body.local_quat_xyzw.clone()
    for joints, seconds in ((_ARMS, limb), (_TRUNK, trunk)):
        there, firm = wanted_quats[:, joints], known[:, joints]
        quats[:, joints] = interpolate_turns(quats[:, joints], there, firm, seconds=seconds, fps=fps)
    offset = interpolate_offsets(
        (posed.root_position - body.root_position) * keys[:, None], ~query.missing.root | keys, seconds=trunk, fps=fps
    )
    made = replace(body, root_position=body.root_position + offset, local_quat_xyzw=quats)
    goals_made, wanted = made.joint_positions(), torch.zeros(made.num_frames, CANONICAL.num_joints, dtype=torch.bool)
    for foot in _FEET:
        firm = keys | ~query.missing.joints[:, CANONICAL.parents[foot]]
        goals_made[:, foot] = positions[:, foot] + interpolate_offsets(
            (goals - positions)[:, foot] * keys[:, None], firm, seconds=limb, fps=fps
        )
    # Legs alone: arms that are to reach something would be turned back to where they were.
    turning = query.missing.joints.index_fill(1, torch.tensor(_ARMS), False)
    return bend_limbs(made, body, goals_made, wanted, turning)


def _compute_duration(distance: Float[Tensor, "frames parts"], least: float, calm: float) -> float:
    """Compute the seconds in which the farthest part goes to its target and back: a spring's of acceleration `calm`."""
    return max(least, math.sqrt(float(distance.max()) / calm))
