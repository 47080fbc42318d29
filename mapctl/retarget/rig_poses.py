"""Poses of a rig whose joints are matched: positions and rotations by canonical joint, and the body's own axes."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from mapctl import kinematics, rotations
from mapctl.motion import Motion
from mapctl.skeleton import CANONICAL, Skeleton

SAMPLES = 200
"""Number of frames of a clip that are looked at, spread over it."""
_APART = 1e-3  # metres between two joints below which they are one

JointOf = Sequence[int | None]
"""For each canonical joint the rig's joint, or None."""


@dataclass(frozen=True, eq=False)
class RigPoses:
    """Poses of one rig in its file's world: frames of a clip, or the single pose with all rotations zero."""

    positions: Float[Tensor, "poses joints 3"]
    """World positions, metres."""
    orientations: Float[Tensor, "poses joints 4"]
    """World rotations (xyzw)."""
    skeleton: Skeleton
    """Skeleton of the rig."""
    joint_of: tuple[int | None, ...]
    """Index of the rig's joint for each canonical joint, or None."""

    @staticmethod
    def zero(skeleton: Skeleton, joint_of: JointOf = range(CANONICAL.num_joints)) -> "RigPoses":
        """Return the pose with all rotations zero; of canonical joints where none are named."""
        still = torch.tensor([0.0, 0.0, 0.0, 1.0], dtype=torch.float64).expand(1, skeleton.num_joints, 4)
        root = torch.zeros(1, 3, dtype=torch.float64)
        return RigPoses(
            *kinematics.forward_kinematics(skeleton.offsets, skeleton.parents, root, still), skeleton, tuple(joint_of)
        )

    @staticmethod
    def of(motion: Motion, joint_of: JointOf) -> "RigPoses":
        """Sample up to SAMPLES frames of a clip, the first among them."""
        picked = torch.linspace(0, motion.num_frames - 1, min(SAMPLES, motion.num_frames)).round().long()
        return RigPoses(
            motion.joint_positions()[picked], motion.joint_rotations()[picked], motion.skeleton, tuple(joint_of)
        )

    def has(self, *names: str) -> bool:
        """Return whether the rig has all these canonical joints."""
        return all(self.joint_of[CANONICAL.index(name)] is not None for name in names)

    def joint(self, name: str) -> int:
        """Return the rig's joint of a canonical one that it has."""
        joint = self.joint_of[CANONICAL.index(name)]
        assert joint is not None
        return joint

    def position(self, name: str) -> Float[Tensor, "poses 3"]:
        """Return the position of a canonical joint that the rig has, metres."""
        return self.positions[:, self.joint(name)]

    def middle(self, part: str) -> Float[Tensor, "poses 3"]:
        """Return the point halfway between the left and the right joint of a part, metres."""
        return (self.position("left" + part) + self.position("right" + part)) / 2

    def across(self, part: str) -> Float[Tensor, "poses 3"]:
        """Return the vector from the right joint of a part to the left, metres."""
        return self.position("left" + part) - self.position("right" + part)

    def end(self, name: str) -> Float[Tensor, "poses 3"] | None:
        """Return the position of the End Site of a canonical joint, metres, if there is one of some length."""
        joint = self.joint_of[CANONICAL.index(name)]
        site = self.skeleton.end_offsets.get(self.skeleton.names[joint]) if joint is not None else None
        if joint is None or site is None or max(map(abs, site)) < 1e-4:
            return None
        offset = torch.tensor(site, dtype=torch.float64).expand(len(self.positions), 3)
        return self.positions[:, joint] + rotations.rotate(self.orientations[:, joint], offset)

    def up(self) -> Float[Tensor, "poses 3"]:
        """Return the unit vector from the thighs to the upper arms."""
        return unit_vectors(self.middle("UpperArm") - self.middle("UpperLeg"))

    def left(self) -> Float[Tensor, "poses 3"]:
        """Return the unit vector along the hip line to the left, square to `up`."""
        across = self.side_line("UpperLeg")
        return unit_vectors(across - self.up() * (across * self.up()).sum(-1, keepdim=True))

    def side_line(self, part: str) -> Float[Tensor, "poses 3"]:
        """Return the vector from the right joint of a part to the left, metres; by the upper arms where the rig has no
        such joints, as shoulders, or both are at one point."""
        across = self.across(part) if self.has("left" + part, "right" + part) else self.across("UpperArm")
        return across if float(across.norm(dim=-1).mean()) > _APART else self.across("UpperArm")

    def bone(self, name: str) -> Float[Tensor, "poses 3"] | None:
        """Return the vector, metres, from a canonical joint to the next one of its limb or trunk that the rig has, or
        to its End Site; None where the rig lacks either end."""
        if not self.has(name):
            return None
        following = next_joint(name)
        while following is not None and not self.has(following):
            following = next_joint(following)
        stop = self.end(name) if following is None else self.position(following)
        return None if stop is None else stop - self.position(name)


def next_joint(name: str) -> str | None:
    """Return the canonical joint that a bone leads to: the knee for the thigh; None for hips and ends of limbs."""
    below = {"spine": "chest", "chest": "neck", "neck": "head"}
    if name in ("hips", *below):
        return below.get(name)
    children = CANONICAL.children(CANONICAL.index(name))
    return CANONICAL.names[children[0]] if children else None


def unit_vectors(vectors: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
    """Scale vectors to length 1; a vanishing one stays zero."""
    return torch.nn.functional.normalize(vectors, dim=-1, eps=1e-9)
