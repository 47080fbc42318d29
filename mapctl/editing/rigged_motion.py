"""A motion on its own rig, put upright, with which of its joints are canonical ones."""

from dataclasses import dataclass, replace
from functools import cached_property

import torch
from jaxtyping import Float
from torch import Tensor

from mapctl import retarget, rotations
from mapctl.motion import Motion
from mapctl.retarget import RigMap
from mapctl.retarget.rigs import Rig
from mapctl.retarget.stance import SIDES
from mapctl.skeleton import CANONICAL

_SAME = 1e-12  # difference of rotations (xyzw) and lengths (metres) that rounding leaves


@dataclass(frozen=True, eq=False)
class RiggedMotion:
    """A motion on its own rig in a world with Y up."""

    motion: Motion
    """The motion, put upright."""
    rigmap: RigMap
    """Its rig, as of the file."""

    @staticmethod
    def of(motion: Motion, rig: Rig | None = None) -> "RiggedMotion":
        """Identify the rig and put the motion upright; RequestError where the rig's joints cannot be identified."""
        rigmap = retarget.identify_rig(motion.skeleton, rig, motion=motion)
        return RiggedMotion(_turn_world(motion, rigmap.upright_quat_xyzw), rigmap)

    def with_motion(self, motion: Motion) -> "RiggedMotion":
        """Return another upright motion of the same rig."""
        return RiggedMotion(motion, self.rigmap)

    @property
    def hips(self) -> int:
        """Index of the rig's hips."""
        return self.rigmap.joints["hips"]

    @cached_property
    def canonical(self) -> Motion:
        """The motion on canonical joints."""
        return retarget.to_canonical(self.motion, self._upright_rig)[0]

    @property
    def _upright_rig(self) -> Rig:
        return replace(retarget.as_rig(self.rigmap), up="y")

    def positions(self, part: str) -> Float[Tensor, "frames 2 3"]:
        """Return world positions, metres, of the left and right canonical joint of a part, as `Toes`.

        Where the rig has an End Site instead, or nothing, it is where the canonical body has it.
        """
        return torch.stack([self.position(side + part) for side in SIDES], dim=1)

    def position(self, name: str) -> Float[Tensor, "frames 3"]:
        """Return the world positions of one canonical joint, metres, as `positions` does."""
        joint = self.rigmap.joints.get(name)
        if joint is not None:
            return self.motion.joint_positions()[:, joint]
        index = CANONICAL.index(name)
        parent = CANONICAL.parents[index]
        bone = self.canonical.skeleton.offsets[index].expand(self.motion.num_frames, 3)
        turned = rotations.rotate(self.canonical.joint_rotations()[:, parent], bone)
        return self.position(CANONICAL.names[parent]) + turned

    def shift_hips(self, shift: Float[Tensor, "frames 3"]) -> Motion:
        """Return the upright motion with its hips, and all that they carry, shifted in the world, metres."""
        joint, moving = self.hips, self.motion.moving_offsets
        if joint not in moving:
            return replace(self.motion, root_position=self.motion.root_position + shift)
        above = self.motion.joint_rotations()[:, self.motion.skeleton.parents[joint]]
        own = moving[joint] + rotations.rotate(rotations.inverse(above), shift)
        return replace(self.motion, moving_offsets={**moving, joint: own})

    def in_file_world(self, like: Motion | None = None) -> Motion:
        """Return the motion in the world of its file. What is as in `like`, but for rounding, has its numbers."""
        up = self.rigmap.upright_quat_xyzw
        motion = _turn_world(self.motion, None if up is None else rotations.inverse(up))
        return motion if like is None else keep_numbers(motion, like)


def _turn_world(motion: Motion, turn: Float[Tensor, "4"] | None) -> Motion:
    if turn is None:
        return motion
    every, local = turn.expand(motion.num_frames, 4), motion.local_quat_xyzw.clone()
    local[:, 0] = rotations.multiply(every, local[:, 0])
    return replace(motion, root_position=rotations.rotate(every, motion.root_position), local_quat_xyzw=local)


def keep_numbers(motion: Motion, like: Motion) -> Motion:
    """Return a motion with the numbers of another of the same skeleton and frames, wherever they differ by rounding
    alone."""
    own, other = motion.local_quat_xyzw, like.local_quat_xyzw
    same = torch.minimum((own - other).abs().amax(-1), (own + other).abs().amax(-1)) < _SAME
    moving = {
        joint: _keep(track, like.moving_offsets[joint]) if joint in like.moving_offsets else track
        for joint, track in motion.moving_offsets.items()
    }
    return replace(
        motion,
        root_position=_keep(motion.root_position, like.root_position),
        local_quat_xyzw=torch.where(same[..., None], other, own),
        moving_offsets=moving,
    )


def _keep(own: Float[Tensor, "frames 3"], other: Float[Tensor, "frames 3"]) -> Float[Tensor, "frames 3"]:
    same = (own - other).abs().amax(dim=-1, keepdim=True) < _SAME
    return torch.where(same, other, own)
