"""The frames that lead from a pose in frame 0 to the motion, where software has mixed the two.

Exporters that filter their channels do so (CMU's takes as BVH: 26, 53, 78 and 95 % of the motion in frames 1 to 4, at
120 a second). Nobody moves like that, so neither a network nor a low-pass filter can be asked for those frames: they
are hidden from both, the motion is continued backward to where it was mixed, and mixed again.
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
from mapctl.recording.masks import ROOT, Mask, expand_masks, travelling_joint
from mapctl.recording.noise_estimation import estimate_angle_noise
from mapctl.recording.pose_mixing import (
    angle_between,
    blend_poses,
    estimate_blend_weights,
    estimate_geodesic_deviation,
    extrapolate_linear,
)
from mapctl.retarget import RigMap

_LINE_FIT_SECONDS = 0.1  # seconds after it that a frame is foreseen from
_SEARCH_SECONDS, _MIN_SEARCH_FRAMES = 0.06, 4  # seconds, and frames, that a pose is mixed into at most
_EVIDENCE_RATIO = 3.0  # times the squares of what fits, where something does not
_UNBLENDED_SHARE = 0.9  # share of the motion from which nothing of the pose is left


@dataclass(frozen=True, eq=False)
class LeadTransition:
    """Frames in which a leading pose is mixed into the motion after it."""

    stop: int
    """The first frame of the capture that nothing of the pose is mixed into; 1 where there are none before it."""
    joints: Bool[Tensor, " joints"]
    """Which joints of the rig are mixed; others are in the motion at once."""
    place: bool
    """Whether the body's place is mixed."""

    def masks(self, names: Sequence[str]) -> tuple[Mask, ...]:
        """What tells nothing of the motion, frames counted from the capture's first."""
        if self.stop == 1:
            return ()
        given = tuple(Mask(name, 1, self.stop) for name, told in zip(names, self.joints.tolist(), strict=True) if told)
        return (*given, Mask(ROOT, 1, self.stop)) if self.place else given


def find_lead_transition(motion: Motion, rigmap: RigMap) -> LeadTransition:
    """Which frames after a leading pose it is mixed into, and which joints."""
    none = LeadTransition(1, torch.zeros(motion.num_joints, dtype=torch.bool), False)
    fps, after = float(motion.fps), motion.num_frames - 1
    longest = min(max(_MIN_SEARCH_FRAMES, math.ceil(_SEARCH_SECONDS * fps)), after - 4)
    if longest < 1:
        return none
    quats, first = rotations.make_sign_continuous(motion.local_quat_xyzw), 1 + longest
    fitted = min(line_fit_frames(fps), after - longest)
    ahead = torch.nn.functional.normalize(extrapolate_linear(quats, first, fitted, upto=longest), dim=-1)
    pose, seen = quats[:1], quats[1:first]
    every = torch.ones(after, motion.num_joints, dtype=torch.bool)
    share = estimate_blend_weights(
        pose, ahead, seen, noise=estimate_angle_noise(quats[1:], every), counts=every[:longest]
    )
    there = (share >= _UNBLENDED_SHARE).nonzero()
    count = int(there[0]) if len(there) else longest
    if count == 0:
        return none
    part, place = slice(0, count), _travelling_position(motion, travelling_joint(motion))
    by_mixing, by_motion = (
        _squared_errors(model, seen[part]) for model in (blend_poses(pose, ahead[part], share[part]), ahead[part])
    )
    limbs, body = torch.ones(motion.num_joints, dtype=torch.bool), hips_and_ancestors(motion, rigmap)
    limbs[body] = False
    if by_mixing[limbs].sum() > by_motion[limbs].sum():
        return none
    joints = _find_blended_joints(by_mixing, by_motion, body)
    onward = extrapolate_linear(place, first, fitted, upto=longest)[part]
    return LeadTransition(1 + count, joints, _is_position_blended(place[:1], onward, place[1 : 1 + count], share[part]))


def _squared_errors(model: Tensor, seen: Tensor) -> Float[Tensor, " joints"]:
    return angle_between(model, seen).square().sum(dim=0)


def _find_blended_joints(
    by_mixing: Float[Tensor, " joints"], by_motion: Float[Tensor, " joints"], body: list[int]
) -> Bool[Tensor, " joints"]:
    """A limb is mixed unless its frames say clearly that it is not; the body as a whole only if they say so."""
    joints = by_mixing <= _EVIDENCE_RATIO * by_motion
    joints[body] = _EVIDENCE_RATIO * by_mixing[body] < by_motion[body]
    return joints


def _is_position_blended(
    pose: Float[Tensor, "1 3"],
    ahead: Float[Tensor, "frames 3"],
    seen: Float[Tensor, "frames 3"],
    share: Float[Tensor, " frames"],
) -> bool:
    away = (seen - torch.lerp(pose, ahead, share[:, None])).square().sum()
    return bool(_EVIDENCE_RATIO * away < (seen - ahead).square().sum())


def restore_lead_transition(
    motion: Motion, pose: Motion, done: DenoiseSolution, found: LeadTransition, masks: Sequence[Mask]
) -> Motion:
    """The clean motion of frame 1 on, with what of the pose is mixed into its first frames."""
    count, last, travels = found.stop - 1, done.motion.num_frames, travelling_joint(motion)
    clean, start = done.motion.slice(0, count), pose.local_quat_xyzw
    seen = rotations.make_sign_continuous(torch.cat([start, motion.local_quat_xyzw[1 : found.stop]]))[1:]
    counts, ahead = ~expand_masks(motion, masks)[0][1 : found.stop] & found.joints, clean.local_quat_xyzw
    share = estimate_blend_weights(start, ahead, seen, noise=done.noise, counts=counts)
    short = blend_poses(start, ahead, share)
    bow = estimate_geodesic_deviation(
        short, seen, share, noise=done.noise, whole=angle_between(start, ahead), counts=counts
    )
    quats = rotations.multiply(short, rotations.from_rotation_vector(bow))
    passing = replace(clean, local_quat_xyzw=torch.where(found.joints[:, None], quats, ahead))
    if found.place:
        place = torch.lerp(_travelling_position(pose, travels), _travelling_position(clean, travels), share[:, None])
        passing = _replace_travelling_position(passing, place, travels)
    return passing if count == last else passing.join(done.motion.slice(count, last))


def hips_and_ancestors(motion: Motion, rigmap: RigMap) -> list[int]:
    """The hips and what carries them: how the body as a whole is turned."""
    above = [joint := rigmap.joint_of[0] or 0]
    while (joint := motion.skeleton.parents[joint]) >= 0:
        above.append(joint)
    return above


def line_fit_frames(fps: float) -> int:
    """How many frames tell which way a motion goes."""
    return max(6, round(_LINE_FIT_SECONDS * fps))


def _travelling_position(motion: Motion, travels: int) -> Float[Tensor, "frames 3"]:
    return motion.moving_offsets[travels] if travels else motion.root_position


def _replace_travelling_position(motion: Motion, place: Float[Tensor, "frames 3"], travels: int) -> Motion:
    if travels:
        return replace(motion, moving_offsets={**motion.moving_offsets, travels: place})
    return replace(motion, root_position=place)
