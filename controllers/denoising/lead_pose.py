"""The T-pose that many captures have in frame 0: how it is detected, and how it is kept.

It resembles a T-pose, and the motion after it does not extrapolate to it. Exporters' filters blend it into the frames
after it (`LeadTransition`).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from controllers.denoising.segment import DenoiseSolution, shift_frames
from mapctl import rotations
from mapctl.motion import Motion
from mapctl.recording.fusion import (
    angle_between,
    blend_poses,
    estimate_blend_weights,
    estimate_geodesic_deviation,
    extrapolate_linear,
    linear_fit_weights,
)
from mapctl.recording.inspection import Artefact
from mapctl.recording.masks import ROOT, Mask, expand_masks
from mapctl.recording.noise_estimation import estimate_angle_noise
from mapctl.retarget import RigMap, from_canonical
from mapctl.retarget.anatomy import RigPoses
from mapctl.skeleton import CANONICAL, LIMBS

_LINE_FIT_SECONDS = 0.1  # seconds after a frame from which it is extrapolated
_SEARCH_SECONDS, _MIN_SEARCH_FRAMES = 0.06, 4  # longest transition, the longer of the two
_EVIDENCE_RATIO = 3.0  # ratio of squared errors at which one model is rejected for the other
_POSITION_EVIDENCE_RATIO = 8.0  # the same for the body's position, which exporters seldom blend: noise may look like it
_UNBLENDED_SHARE = 0.9  # share of the motion from which a frame counts as free of the pose


@dataclass(frozen=True, eq=False)
class LeadTransition:
    """Frames in which a lead pose is blended into the motion after it."""

    stop: int
    """First frame of the capture that is free of the pose; 1 where there is no transition."""
    joints: Bool[Tensor, " joints"]
    """Whether a joint of the rig is blended; others follow the motion from frame 1 on."""
    position: bool
    """Whether the body's position is blended."""

    def masks(self, names: Sequence[str]) -> tuple[Mask, ...]:
        """Return masks of the blended joints and frames, counted from the capture's first frame."""
        if self.stop == 1:
            return ()
        joints = tuple(
            Mask(name, 1, self.stop) for name, blended in zip(names, self.joints.tolist(), strict=True) if blended
        )
        return (*joints, Mask(ROOT, 1, self.stop)) if self.position else joints


def find_lead_transition(motion: Motion, rigmap: RigMap) -> LeadTransition:
    """Find the frames and joints into which a lead pose is blended."""
    none = LeadTransition(1, torch.zeros(motion.num_joints, dtype=torch.bool), False)
    fps, after = float(motion.fps), motion.num_frames - 1
    longest = min(max(_MIN_SEARCH_FRAMES, math.ceil(_SEARCH_SECONDS * fps)), after - 4)
    if longest < 1:
        return none
    quats, first = rotations.make_sign_continuous(motion.local_quat_xyzw), 1 + longest
    fitted = min(line_fit_frames(fps), after - longest)
    ahead = torch.nn.functional.normalize(extrapolate_linear(quats, first, fitted, upto=longest), dim=-1)
    lead, observed = quats[:1], quats[1:first]
    every = torch.ones(after, motion.num_joints, dtype=torch.bool)
    share = estimate_blend_weights(
        lead, ahead, observed, noise=estimate_angle_noise(quats[1:], every), counts=every[:longest]
    )
    unblended = (share >= _UNBLENDED_SHARE).nonzero()
    count = int(unblended[0]) if len(unblended) else longest
    if count == 0:
        return none
    part, position = slice(0, count), _travelling_position(motion, motion.travelling_joint)
    blended = blend_poses(lead, ahead[part], share[part])
    by_mixing, by_motion = (_squared_errors(model, observed[part]) for model in (blended, ahead[part]))
    limbs, body = torch.ones(motion.num_joints, dtype=torch.bool), hips_and_ancestors(motion, rigmap)
    limbs[body] = False
    if by_mixing[limbs].sum() > by_motion[limbs].sum():
        return none
    joints = _find_blended_joints(by_mixing, by_motion, body)
    extrapolated = extrapolate_linear(position, first, fitted, upto=longest)[part]
    return LeadTransition(
        1 + count, joints, _is_position_blended(position[:1], extrapolated, position[1 : 1 + count], share[part])
    )


def _squared_errors(model: Tensor, observed: Tensor) -> Float[Tensor, " joints"]:
    return angle_between(model, observed).square().sum(dim=0)


def _find_blended_joints(
    by_mixing: Float[Tensor, " joints"], by_motion: Float[Tensor, " joints"], body: list[int]
) -> Bool[Tensor, " joints"]:
    """Find the blended joints: limbs unless the evidence is against it, hips and ancestors only where it is for it."""
    joints = by_mixing <= _EVIDENCE_RATIO * by_motion
    joints[body] = _EVIDENCE_RATIO * by_mixing[body] < by_motion[body]
    return joints


def _is_position_blended(
    pose: Float[Tensor, "1 3"],
    ahead: Float[Tensor, "frames 3"],
    observed: Float[Tensor, "frames 3"],
    share: Float[Tensor, " frames"],
) -> bool:
    away = (observed - torch.lerp(pose, ahead, share[:, None])).square().sum()
    return bool(_POSITION_EVIDENCE_RATIO * away < (observed - ahead).square().sum())


def restore_lead_transition(
    motion: Motion, pose: Motion, done: DenoiseSolution, transition: LeadTransition, masks: Sequence[Mask]
) -> Motion:
    """Return the clean motion from frame 1 on, with the pose blended into its first frames."""
    count, last, travels = transition.stop - 1, done.motion.num_frames, motion.travelling_joint
    clean, start = done.motion.slice(0, count), pose.local_quat_xyzw
    observed = rotations.make_sign_continuous(torch.cat([start, motion.local_quat_xyzw[1 : transition.stop]]))[1:]
    counts, ahead = ~expand_masks(motion, masks)[0][1 : transition.stop] & transition.joints, clean.local_quat_xyzw
    share = estimate_blend_weights(start, ahead, observed, noise=done.noise, counts=counts)
    geodesic = blend_poses(start, ahead, share)
    deviation = estimate_geodesic_deviation(
        geodesic, observed, share, noise=done.noise, whole=angle_between(start, ahead), counts=counts
    )
    quats = rotations.multiply(geodesic, rotations.from_rotation_vector(deviation))
    passing = replace(clean, local_quat_xyzw=torch.where(transition.joints[:, None], quats, ahead))
    if transition.position:
        position = torch.lerp(_travelling_position(pose, travels), _travelling_position(clean, travels), share[:, None])
        passing = _replace_travelling_position(passing, position, travels)
    return passing if count == last else passing.join(done.motion.slice(count, last))


def hips_and_ancestors(motion: Motion, rigmap: RigMap) -> list[int]:
    """List the hips and their ancestors, which orient the body as a whole."""
    above = [joint := rigmap.joint_of[0] or 0]
    while (joint := motion.skeleton.parents[joint]) >= 0:
        above.append(joint)
    return above


def line_fit_frames(fps: float) -> int:
    """Return the number of frames from which a motion is extrapolated."""
    return max(6, round(_LINE_FIT_SECONDS * fps))


def _travelling_position(motion: Motion, travels: int) -> Float[Tensor, "frames 3"]:
    return motion.moving_offsets[travels] if travels else motion.root_position


def _replace_travelling_position(motion: Motion, position: Float[Tensor, "frames 3"], travels: int) -> Motion:
    if travels:
        return replace(motion, moving_offsets={**motion.moving_offsets, travels: position})
    return replace(motion, root_position=position)


_TPOSE_TOLERANCE, _REST_TOLERANCE = math.radians(40), math.radians(35)  # limb of a noisy frame to that of the pose
_MIN_OUTLIER_ANGLE = math.radians(60)  # least angle of an outlier, all joints together
_OUTLIER_RATIO = 2.0  # and its ratio to the motion's own prediction errors
_SKIPPED_SECONDS = 0.05  # seconds skipped in a prediction, since the pose may be blended into them
_REST_NOISE_RATIO = 5.0  # largest rotation of a resting joint, in units of the noise of one angle
_NOISY_SIGMA, _MAX_SPIKE_ANGLE = math.radians(1.0), math.radians(60.0)


def has_lead_pose(motion: Motion, canonical: Motion, rigmap: RigMap) -> bool:
    """Return whether frame 0 is a pose that does not belong to the motion: a T-pose, or the rig's zero pose.

    `canonical` is the same motion in canonical joint frames. Both may be noisy: a clear T-pose must differ from most of
    the motion, one that is less clear must be an outlier of it.
    """
    if motion.num_frames < 2:
        return False
    if _is_clear_tpose(canonical):
        return True
    return (_resembles_tpose(canonical) or _is_near_zero_pose(motion, rigmap)) and _is_first_frame_outlier(canonical)


def restore_lead_pose(
    motion: Motion, done: DenoiseSolution, rigmap: RigMap, transition: LeadTransition, masks: Sequence[Mask]
) -> DenoiseSolution:
    """Put the pose in frame 0, and the frames into which it is blended, before the motion denoised from frame 1 on.

    Joints of the pose that are at rest but for noise are snapped to rest. `masks` are the user's, of the whole capture.
    """
    pose = _snap_to_rest_pose(motion, done, rigmap)
    clean = restore_lead_transition(motion, pose, done, transition, masks) if transition.stop > 1 else done.motion
    faults = shift_frames(_drop_transition_faults(motion, done.faults, transition, masks), 1)
    intervals = shift_frames(done.density_intervals, 1)
    notes = ["frame 0 is a T-pose, or the rest pose: it stays, but for noise of joints at rest"]
    if transition.stop > 1:
        notes.append(
            f"frames 1 to {transition.stop - 1} mix it into the motion, as exporters' filters do, and stay mixed"
        )
    return replace(
        done,
        motion=pose.join(clean),
        capture=motion,
        faults=tuple(faults),
        density_intervals=tuple(intervals),
        status=replace(done.status, notes=(*notes, *done.notes)),
    )


def _is_clear_tpose(canonical: Motion) -> bool:
    """Return whether frame 0 has its arms out and all joints straight, and most other frames have not."""
    turned = torch.rad2deg(rotations.to_rotation_vector(canonical.local_quat_xyzw[:, 1:]).norm(dim=-1))
    arms = turned[:, [CANONICAL.index(name) - 1 for name in ("leftUpperArm", "rightUpperArm")]].amin(dim=-1)
    return bool(arms[0] < 25) and bool(turned[0].mean() < 15) and bool(arms[1:].median() > 40)


def _resembles_tpose(canonical: Motion) -> bool:
    """Return whether frame 0 has its arms out and its legs down by the positions of its joints, so independently of the
    T-pose that the rig is assumed to have.
    """
    first = RigPoses.of(canonical.slice(0, 1), range(CANONICAL.num_joints))
    up, left = first.up()[0], first.left()[0]
    expected = (
        ("leftUpperArm", "leftHand", left),
        ("rightUpperArm", "rightHand", -left),
        ("leftUpperLeg", "leftFoot", -up),
        ("rightUpperLeg", "rightFoot", -up),
    )
    directions = [(first.position(stop)[0] - first.position(start)[0], axis) for start, stop, axis in expected]
    return all(
        float(direction @ axis) > math.cos(_TPOSE_TOLERANCE) * float(direction.norm()) for direction, axis in directions
    )


def _is_near_zero_pose(motion: Motion, rigmap: RigMap) -> bool:
    """Return whether the limbs' rotations in frame 0 are near zero."""
    joints = [j for limb in LIMBS.values() for k in (limb.upper, limb.lower) if (j := rigmap.joint_of[k]) is not None]
    return bool((rotations.to_rotation_vector(motion.local_quat_xyzw[0, joints]).norm(dim=-1) < _REST_TOLERANCE).all())


def _is_first_frame_outlier(canonical: Motion) -> bool:
    """Return whether extrapolating the motion backward misses frame 0 by far more than it misses the other frames."""
    fps, frames = float(canonical.fps), canonical.num_frames
    skipped = max(1, round(_SKIPPED_SECONDS * fps))
    fitted = min(line_fit_frames(fps), frames - 1 - skipped)
    if fitted < 2:
        return False
    quats = rotations.make_sign_continuous(canonical.local_quat_xyzw[:, 1:])
    windows = quats[1 + skipped - 1 :].unfold(0, fitted, 1)  # for frame t those from t + skipped on
    predicted = torch.nn.functional.normalize(windows @ linear_fit_weights(fitted, -float(skipped)), dim=-1)
    errors = angle_between(predicted, quats[: len(predicted)]).square().sum(dim=-1)
    own = errors[skipped + 1 :]  # the pose is not blended into these
    if len(own) < fitted:
        return float(errors[0]) > 2 * _MIN_OUTLIER_ANGLE**2
    typical = own.median()
    return float(errors[0] - typical) > max(_MIN_OUTLIER_ANGLE**2, _OUTLIER_RATIO * float(own.quantile(0.98) - typical))


def _snap_to_rest_pose(motion: Motion, done: DenoiseSolution, rigmap: RigMap) -> Motion:
    """Return frame 0 with those joints at rest that are so but for noise."""
    first = motion.slice(0, 1)
    poses = _list_rest_poses(motion, rigmap)
    rest = min(poses, key=lambda quats: float(angle_between(quats, first.local_quat_xyzw).mean()))
    # In a noisy capture a joint that is further off is a spike.
    reach = torch.where(done.noise > _NOISY_SIGMA, _MAX_SPIKE_ANGLE, _REST_NOISE_RATIO * done.noise)
    # Not so the hips and their ancestors: a T-pose may face in another direction than the rig's.
    body = hips_and_ancestors(motion, rigmap)
    reach[body] = _REST_NOISE_RATIO * done.noise[body]
    at_rest = angle_between(rest, first.local_quat_xyzw) < reach
    return replace(first, local_quat_xyzw=torch.where(at_rest[..., None], rest, first.local_quat_xyzw))


def _list_rest_poses(motion: Motion, rigmap: RigMap) -> list[Float[Tensor, "1 joints 4"]]:
    """List the local rotations of possible rest poses: zero, as in CMU's takes, and those of the rig's T-pose."""
    none = torch.tensor([0.0, 0.0, 0.0, 1.0], dtype=torch.float64)
    root, quats = torch.zeros(1, 3, dtype=torch.float64), none.expand(1, CANONICAL.num_joints, 4)
    tpose = Motion(rigmap.skeleton, motion.fps, root, quats)
    return [none.expand(1, motion.num_joints, 4), from_canonical(tpose, rigmap).local_quat_xyzw]


def _drop_transition_faults(
    motion: Motion, faults: Sequence[Artefact], transition: LeadTransition, masks: Sequence[Mask]
) -> list[Artefact]:
    """Return artefacts from frame 1 on without the dropouts that mask the transition; what the user masked stays."""
    names, masked = motion.skeleton.names, expand_masks(motion, masks)[0]
    kept = []
    for fault in faults:
        if (
            fault.kind == "dropout"
            and fault.start + 1 < transition.stop
            and transition.joints[names.index(fault.joint)]
        ):
            own = masked[1 : transition.stop, names.index(fault.joint)]
            start = int(own.nonzero()[0]) if bool(own.any()) else transition.stop - 1
            if start >= fault.stop:
                continue
            fault = replace(fault, start=start)
        kept.append(fault)
    return kept
