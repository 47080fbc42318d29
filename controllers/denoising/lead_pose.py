"""A pose before the motion, as many captures have a T-pose in frame 0: how it is told, and what becomes of it.

It looks like one, and the motion after it does not lead there. See denoise_passage for the frames it is mixed into.
"""

import math
from collections.abc import Sequence
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from controllers.denoising.lead_transition import (
    LeadTransition,
    hips_and_ancestors,
    line_fit_frames,
    restore_lead_transition,
)
from controllers.denoising.result import DenoiseSolution, shift_frames
from mapctl import rotations
from mapctl.motion import Motion
from mapctl.recording.artefacts import Artefact
from mapctl.recording.masks import Mask, expand_masks
from mapctl.recording.pose_mixing import angle_between, linear_fit_weights
from mapctl.retarget import RigMap, from_canonical
from mapctl.retarget.pose_axes import RigPoses
from mapctl.skeleton import CANONICAL, LIMBS

_TPOSE_TOLERANCE, _REST_TOLERANCE = (
    math.radians(40),
    math.radians(35),
)  # of a limb in a noisy frame, from where a pose has it
_MIN_OUTLIER_ANGLE, _OUTLIER_RATIO = (
    math.radians(60),
    2.0,
)  # of all joints together, at least; and times what the motion does by itself
_SKIPPED_SECONDS = 0.05  # seconds left out before a frame is foreseen: what a pose may be mixed into
_REST_NOISE_RATIO = 5.0  # times the noise of one angle, that a resting joint is turned by at most
_NOISY_SIGMA, _MAX_SPIKE_ANGLE = math.radians(1.0), math.radians(60.0)


def has_lead_pose(motion: Motion, canonical: Motion, rigmap: RigMap) -> bool:
    """Whether frame 0 is a pose that the motion does not begin with: a T-pose, or the rig's own pose of no rotations.

    `canonical` is the same motion in canonical joint frames. Both may be noisy: a clear T-pose must differ from most of
    the motion, what only resembles one must be out of reach for it.
    """
    if motion.num_frames < 2:
        return False
    if _is_clear_tpose(canonical):
        return True
    return (_resembles_tpose(canonical) or _is_near_zero_pose(motion, rigmap)) and _is_first_frame_outlier(canonical)


def restore_lead_pose(
    motion: Motion, done: DenoiseSolution, rigmap: RigMap, found: LeadTransition, masks: Sequence[Mask]
) -> DenoiseSolution:
    """What was cleaned of frame 1 on, led by the pose in frame 0 and by the frames that it is mixed into.

    Joints of the pose go back to rest that are there but for the noise. `masks` are the user's, of the whole capture.
    """
    pose = _snap_to_rest_pose(motion, done, rigmap)
    clean = restore_lead_transition(motion, pose, done, found, masks) if found.stop > 1 else done.motion
    faults = shift_frames(_drop_transition_faults(motion, done.faults, found, masks), 1)
    intervals = shift_frames(done.density_intervals, 1)
    notes = ["frame 0 is a T-pose, or the rest pose: it stays, but for noise of joints at rest"]
    if found.stop > 1:
        notes.append(f"frames 1 to {found.stop - 1} mix it into the motion, as exporters' filters do, and stay mixed")
    return replace(
        done,
        motion=pose.join(clean),
        capture=motion,
        faults=tuple(faults),
        density_intervals=tuple(intervals),
        status=replace(done.status, notes=(*notes, *done.notes)),
    )


def _is_clear_tpose(canonical: Motion) -> bool:
    """Arms out, everything straight, and then not."""
    turned = torch.rad2deg(rotations.to_rotation_vector(canonical.local_quat_xyzw[:, 1:]).norm(dim=-1))
    arms = turned[:, [CANONICAL.index(name) - 1 for name in ("leftUpperArm", "rightUpperArm")]].amin(dim=-1)
    return bool(arms[0] < 25) and bool(turned[0].mean() < 15) and bool(arms[1:].median() > 40)


def _resembles_tpose(canonical: Motion) -> bool:
    """Whether frame 0 has its arms out and its legs down, by the places of its joints: whatever T-pose the rig is
    thought to have.
    """
    first = RigPoses.of(canonical.slice(0, 1), range(CANONICAL.num_joints))
    up, left = first.up()[0], first.left()[0]
    aims = (
        ("leftUpperArm", "leftHand", left),
        ("rightUpperArm", "rightHand", -left),
        ("leftUpperLeg", "leftFoot", -up),
        ("rightUpperLeg", "rightFoot", -up),
    )
    ways = [(first.place(stop)[0] - first.place(start)[0], aim) for start, stop, aim in aims]
    return all(float(way @ aim) > math.cos(_TPOSE_TOLERANCE) * float(way.norm()) for way, aim in ways)


def _is_near_zero_pose(motion: Motion, rigmap: RigMap) -> bool:
    """Whether the limbs of frame 0 are turned as little as in the pose of no rotations."""
    joints = [j for limb in LIMBS.values() for k in (limb.upper, limb.lower) if (j := rigmap.joint_of[k]) is not None]
    return bool((rotations.to_rotation_vector(motion.local_quat_xyzw[0, joints]).norm(dim=-1) < _REST_TOLERANCE).all())


def _is_first_frame_outlier(canonical: Motion) -> bool:
    """Whether the motion, continued backward, misses frame 0 by far more than it misses frames of its own."""
    fps, frames = float(canonical.fps), canonical.num_frames
    skipped = max(1, round(_SKIPPED_SECONDS * fps))
    fitted = min(line_fit_frames(fps), frames - 1 - skipped)
    if fitted < 2:
        return False
    quats = rotations.make_sign_continuous(canonical.local_quat_xyzw[:, 1:])
    windows = quats[1 + skipped - 1 :].unfold(0, fitted, 1)  # of frame t those from t + skipped on
    foreseen = torch.nn.functional.normalize(windows @ linear_fit_weights(fitted, -float(skipped)), dim=-1)
    away = angle_between(foreseen, quats[: len(foreseen)]).square().sum(dim=-1)
    own = away[skipped + 1 :]  # nothing of the pose is mixed into these
    if len(own) < fitted:
        return float(away[0]) > 2 * _MIN_OUTLIER_ANGLE**2
    usual = own.median()
    return float(away[0] - usual) > max(_MIN_OUTLIER_ANGLE**2, _OUTLIER_RATIO * float(own.quantile(0.98) - usual))


def _snap_to_rest_pose(motion: Motion, done: DenoiseSolution, rigmap: RigMap) -> Motion:
    """Frame 0, joints at rest that are there but for the noise."""
    first = motion.slice(0, 1)
    rest = min(
        _list_rest_poses(motion, rigmap), key=lambda quats: float(angle_between(quats, first.local_quat_xyzw).mean())
    )
    # In a noisy capture a joint that is further off has been hit by a spike.
    reach = torch.where(done.noise > _NOISY_SIGMA, _MAX_SPIKE_ANGLE, _REST_NOISE_RATIO * done.noise)
    # But for the hips and what carries them: a T-pose may face another way than the rig's.
    body = hips_and_ancestors(motion, rigmap)
    reach[body] = _REST_NOISE_RATIO * done.noise[body]
    at_rest = angle_between(rest, first.local_quat_xyzw) < reach
    return replace(first, local_quat_xyzw=torch.where(at_rest[..., None], rest, first.local_quat_xyzw))


def _list_rest_poses(motion: Motion, rigmap: RigMap) -> list[Float[Tensor, "1 joints 4"]]:
    """Local rotations that a T-pose may be meant to have: none, as in CMU's takes, and those of the rig's T-pose."""
    none = torch.tensor([0.0, 0.0, 0.0, 1.0], dtype=torch.float64)
    tpose = Motion(
        rigmap.skeleton, motion.fps, torch.zeros(1, 3, dtype=torch.float64), none.expand(1, CANONICAL.num_joints, 4)
    )
    return [none.expand(1, motion.num_joints, 4), from_canonical(tpose, rigmap).local_quat_xyzw]


def _drop_transition_faults(
    motion: Motion, faults: Sequence[Artefact], found: LeadTransition, masks: Sequence[Mask]
) -> list[Artefact]:
    """Faults of frame 1 on, less the dropouts that the passage was taken for; what the user masked is one."""
    names, lost = motion.skeleton.names, expand_masks(motion, masks)[0]
    kept = []
    for fault in faults:
        if fault.kind == "dropout" and fault.start + 1 < found.stop and found.joints[names.index(fault.joint)]:
            own = lost[1 : found.stop, names.index(fault.joint)]
            start = int(own.nonzero()[0]) if bool(own.any()) else found.stop - 1
            if start >= fault.stop:
                continue
            fault = replace(fault, start=start)
        kept.append(fault)
    return kept
