"""Benchmark of joints that are missing throughout (Kaufmann et al. 2020, figure 8), beside their mean pose."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from controllers.benchmarks.infilling import WINDOW_FRAMES, scale_to_canonical_bones, slice_middle
from controllers.benchmarks.shared.tables import Row
from controllers.inbetweening.infill import infill
from controllers.inbetweening.proposers import AutoInbetweener
from mapctl import rotations
from mapctl.motion import Motion
from mapctl.protocols import Inbetweener
from mapctl.recording.masks import Mask
from mapctl.skeleton import CANONICAL

MISSING_LIMBS = {
    "elbow and hand": ("leftLowerArm", "leftHand"),
    "knee, foot and toes": ("rightLowerLeg", "rightFoot", "rightToes"),
}
"""Missing joints by name, as in Kaufmann et al. 2020, figure 8."""


def benchmark_missing_joints(kinds: Mapping[str, Sequence[Motion]], inbetweener: Inbetweener) -> list[Row]:
    """Measure joints that are missing throughout up to 240 frames, by kind of clip: their mean error in the world, cm,
    by MAP and by two mean poses: that of all these clips, and the clip's own, which no user knows.
    """
    shown = {kind: _select_clips(clips) for kind, clips in kinds.items()}
    every = [clip for clips in shown.values() for clip in clips]
    if not every:
        return []
    mean_pose, rows = average_pose(every), []
    for kind, clips in shown.items():
        for name, joints in MISSING_LIMBS.items():
            found = []
            for clip in clips:
                masks = [Mask(joint, 0, clip.num_frames) for joint in joints]
                made = infill(clip, AutoInbetweener(inbetweener), masks).motion
                poses = (mean_pose, average_pose([clip]))
                candidates = [*(replace_joint_rotations(clip, joints, pose) for pose in poses), made]
                found.append([_mean_joint_distance(motion, clip, joints) for motion in candidates])
            if found:
                mean_cm, own_mean_cm, map_cm = (100 * torch.tensor(found)).mean(dim=0).tolist()
                row = {"task": f"{name} lost", "clips": len(found), "method": f"MAP on {kind}", "error_cm": map_cm}
                row |= {"mean_pose_cm": mean_cm, "own_mean_pose_cm": own_mean_cm, "ratio": map_cm / mean_cm}
                rows.append(row)
    return rows


def average_pose(motions: Sequence[Motion]) -> Float[Tensor, "joints 4"]:
    """Return the mean rotation of every joint over all frames, every motion counting alike."""
    weights = torch.cat([torch.ones(motion.num_frames, dtype=torch.float64) / motion.num_frames for motion in motions])
    return rotations.average(torch.cat([motion.local_quat_xyzw for motion in motions]), weights)


def replace_joint_rotations(motion: Motion, joints: Sequence[str], pose: Float[Tensor, "joints 4"]) -> Motion:
    """Replace the rotations of joints, and of the parent of the first of them, by those of a pose."""
    indices = [CANONICAL.index(name) for name in joints]
    quats = motion.local_quat_xyzw.clone()
    for joint in {CANONICAL.parents[indices[0]], *indices}:
        quats[:, joint] = pose[joint]
    return replace(motion, local_quat_xyzw=quats)


def _select_clips(clips: Sequence[Motion]) -> list[Motion]:
    """Return up to 240 frames of the clips that have at least 120."""
    long = [clip for clip in map(scale_to_canonical_bones, clips) if clip.num_frames >= WINDOW_FRAMES]
    return [slice_middle(clip, min(clip.num_frames, 2 * WINDOW_FRAMES)) for clip in long]


def _mean_joint_distance(motion: Motion, truth: Motion, joints: Sequence[str]) -> float:
    """Compute the mean distance of the joints, metres."""
    indices = [CANONICAL.index(name) for name in joints]
    return float((motion.joint_positions() - truth.joint_positions())[:, indices].norm(dim=-1).mean())
