"""Missing values of a motion on any rig, and their linear interpolation."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mapctl import rotations
from mapctl.errors import RequestError
from mapctl.motion import Motion
from mapctl.numerics.intervals import fill_missing, last_observed, next_observed
from mapctl.recording.masks import Mask, expand_masks
from mapctl.retarget import RigMap
from mapctl.skeleton import CANONICAL


@dataclass(frozen=True, eq=False)
class MissingMask:
    """Mask of the missing values of a motion."""

    joints: Bool[Tensor, "frames joints"]
    """Whether a joint's rotation is missing, by joint of the rig."""
    root: Bool[Tensor, " frames"]
    """Whether the body's position is missing."""

    @staticmethod
    def of_masks(motion: Motion, masks: Sequence[Mask], rigmap: RigMap, *, keep_position: bool = True) -> "MissingMask":
        """Build the mask from masks by joint. Where a joint is missing so is its parent's rotation, unless the parent
        has other children that show it. RequestError for joints and frames that the motion has not, and where nothing
        of it is left: no joint, or no position of the body unless that may be so."""
        for mask in masks:
            if mask.stop > motion.num_frames:
                raise RequestError(
                    f"the gap {mask.start}:{mask.stop} ends after the motion's {motion.num_frames} frames"
                )
        joints, root = expand_masks(motion, masks)
        joints = joints.clone()
        for child, parent in enumerate(CANONICAL.parents):
            own, above = rigmap.joint_of[child], rigmap.joint_of[parent] if parent >= 0 else None
            if own is not None and above is not None and len(CANONICAL.children(parent)) == 1:
                joints[:, above] |= joints[:, own]
        if (keep_position and root.all()) or bool(joints.all()):
            raise RequestError(f"the gaps leave nothing of the motion's {motion.num_frames} frames to go by")
        return MissingMask(joints, root)

    @staticmethod
    def of_frames(missing: Bool[Tensor, " frames"], joints: int) -> "MissingMask":
        """Build the mask of whole frames of a motion with so many joints."""
        return MissingMask(missing[:, None].expand(-1, joints).clone(), missing)

    @property
    def frames(self) -> Bool[Tensor, " frames"]:
        """Frames in which anything is missing."""
        return self.root | self.joints.any(dim=1)

    def slice(self, start: int, stop: int) -> "MissingMask":
        """Return frames start to stop."""
        return MissingMask(self.joints[start:stop], self.root[start:stop])


def interpolate_missing(motion: Motion, missing: MissingMask) -> Motion:
    """Interpolate missing values from the nearest known frames on both sides: joints by slerp, positions linearly;
    beyond the first and the last known frame they hold, and joints that are never known rest."""
    known = ~missing.joints.T
    before, after = last_observed(known).T, next_observed(known).T
    quats = motion.local_quat_xyzw
    start, stop = (torch.take_along_dim(quats, frame[..., None], dim=0) for frame in (before, after))
    frame = torch.arange(motion.num_frames)[:, None]
    weight = ((frame - before).to(quats) / (after - before).clamp_min(1)).clamp(0, 1)
    between = rotations.slerp(start, stop, weight)
    rest = quats.new_tensor([0.0, 0.0, 0.0, 1.0]).expand_as(quats)
    between = torch.where(known.any(dim=1)[None, :, None], between, rest)
    moving = {joint: _interpolate_root(values, missing.root) for joint, values in motion.moving_offsets.items()}
    return replace(
        motion,
        local_quat_xyzw=torch.where(missing.joints[..., None], between, quats),
        root_position=_interpolate_root(motion.root_position, missing.root),
        moving_offsets=moving,
    )


def restore_observed(motion: Motion, original: Motion, missing: MissingMask) -> Motion:
    """Return the original with its missing values from `motion`, of the same rig and length; all else to the bit."""
    moving = {
        joint: torch.where(missing.root[:, None], motion.moving_offsets[joint], values)
        for joint, values in original.moving_offsets.items()
    }
    return replace(
        original,
        moving_offsets=moving,
        root_position=torch.where(missing.root[:, None], motion.root_position, original.root_position),
        local_quat_xyzw=torch.where(missing.joints[..., None], motion.local_quat_xyzw, original.local_quat_xyzw),
    )


def _interpolate_root(values: Float[Tensor, "frames 3"], missing: Bool[Tensor, " frames"]) -> Float[Tensor, "frames 3"]:
    return torch.where(missing[:, None], fill_missing(values[None], ~missing[None])[0], values)
