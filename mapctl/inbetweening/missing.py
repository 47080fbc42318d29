"""What a motion on any rig lacks, and what it is without anything better: straight lines between what is known."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mapctl import rotations
from mapctl.errors import RequestError
from mapctl.motion import Motion
from mapctl.numerics.intervals import filled, last_seen, next_seen
from mapctl.recording.masks import Mask, hidden
from mapctl.retarget import RigMap
from mapctl.skeleton import CANONICAL


@dataclass(frozen=True, eq=False)
class Lost:
    """What of a motion's frames counts for nothing."""

    joints: Bool[Tensor, "frames joints"]
    """Rotations, by joint of the rig."""
    root: Bool[Tensor, " frames"]
    """Where the body is."""

    @staticmethod
    def of_masks(motion: Motion, masks: Sequence[Mask], rigmap: RigMap) -> "Lost":
        """By masks. A joint whose place is lost takes the rotation that put it there along: its parent's, unless others
        show that too. RequestError for joints and frames that the motion has not, and where nothing is left of it.
        """
        for mask in masks:
            if mask.stop > motion.num_frames:
                raise RequestError(
                    f"the gap {mask.start}:{mask.stop} ends after the motion's {motion.num_frames} frames"
                )
        joints, root = hidden(motion, masks)
        joints = joints.clone()
        for child, parent in enumerate(CANONICAL.parents):
            own, above = rigmap.joint_of[child], rigmap.joint_of[parent] if parent >= 0 else None
            if own is not None and above is not None and len(CANONICAL.children(parent)) == 1:
                joints[:, above] |= joints[:, own]
        if root.all() or bool(joints.all()):
            raise RequestError(f"the gaps leave nothing of the motion's {motion.num_frames} frames to go by")
        return Lost(joints, root)

    @property
    def frames(self) -> Bool[Tensor, " frames"]:
        """In which anything is lost."""
        return self.root | self.joints.any(dim=1)

    def slice(self, start: int, stop: int) -> "Lost":
        """Frames start to stop."""
        return Lost(self.joints[start:stop], self.root[start:stop])


def straight(motion: Motion, lost: Lost) -> Motion:
    """What is lost, from the nearest known frames on both sides: joints by slerp, places by straight lines; beyond the
    first and the last known frame they hold, and joints that are never known rest.
    """
    known = ~lost.joints.T
    before, after = last_seen(known).T, next_seen(known).T
    quats = motion.local_quat_xyzw
    start, stop = (torch.take_along_dim(quats, frame[..., None], dim=0) for frame in (before, after))
    frame = torch.arange(motion.num_frames)[:, None]
    weight = ((frame - before).to(quats) / (after - before).clamp_min(1)).clamp(0, 1)
    between = rotations.slerp(start, stop, weight)
    rest = quats.new_tensor([0.0, 0.0, 0.0, 1.0]).expand_as(quats)
    between = torch.where(known.any(dim=1)[None, :, None], between, rest)
    moving = {joint: _held(values, lost.root) for joint, values in motion.moving_offsets.items()}
    return replace(
        motion,
        local_quat_xyzw=torch.where(lost.joints[..., None], between, quats),
        root_position=_held(motion.root_position, lost.root),
        moving_offsets=moving,
    )


def put_back(motion: Motion, original: Motion, lost: Lost) -> Motion:
    """The original with what it lacks from `motion`, of the same rig and length; all else to the bit."""
    moving = {
        joint: torch.where(lost.root[:, None], motion.moving_offsets[joint], values)
        for joint, values in original.moving_offsets.items()
    }
    return replace(
        original,
        moving_offsets=moving,
        root_position=torch.where(lost.root[:, None], motion.root_position, original.root_position),
        local_quat_xyzw=torch.where(lost.joints[..., None], motion.local_quat_xyzw, original.local_quat_xyzw),
    )


def _held(values: Float[Tensor, "frames 3"], lost: Bool[Tensor, " frames"]) -> Float[Tensor, "frames 3"]:
    return torch.where(lost[:, None], filled(values[None], ~lost[None])[0], values)
