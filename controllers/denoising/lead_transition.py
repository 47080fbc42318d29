"""The transition from a lead pose in frame 0 to the motion, where software has blended the two.

Exporters that filter their channels do so (CMU's takes as BVH: 26, 53, 78 and 95 % of the motion in frames 1 to 4, at
120 frames/s). Those frames are not human motion, so neither a network nor a low-pass filter can restore them: they are
masked, the motion is extrapolated backward through them, and blended with the pose again.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from controllers.denoising.result import DenoiseSolution
from mapctl import rotations
from mapctl.motion import Motion
from mapctl.recording.masks import ROOT, Mask, expand_masks
from mapctl.recording.noise_estimation import estimate_angle_noise
from mapctl.recording.pose_mixing import (
    angle_between,
    blend_poses,
    estimate_blend_weights,
    estimate_geodesic_deviation,
    extrapolate_linear,
)
from mapctl.retarget import RigMap

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
