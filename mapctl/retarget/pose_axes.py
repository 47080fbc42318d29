"""The up, forward and left axes that a pose of an unknown rig shows by its joints' positions."""

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
_UPRIGHT_COSINE = 0.8  # least cosine between the vertical axis and an upright body
_MIN_HANDEDNESS = 0.3  # least triple product left x up . toes from which the facing is inferred

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
    def zero(skeleton: Skeleton, joint_of: JointOf) -> "RigPoses":
        """Return the pose with all rotations zero."""
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

    def first(self) -> "RigPoses":
        """Return the first pose alone."""
        return RigPoses(self.positions[:1], self.orientations[:1], self.skeleton, self.joint_of)

    def has(self, *names: str) -> bool:
        """Return whether the rig has all these canonical joints."""
        return all(self.joint_of[CANONICAL.index(name)] is not None for name in names)

    def place(self, name: str) -> Float[Tensor, "poses 3"]:
        """Return the position of a canonical joint that the rig has, metres."""
        joint = self.joint_of[CANONICAL.index(name)]
        assert joint is not None
        return self.positions[:, joint]

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
        high = self.place("leftUpperArm") + self.place("rightUpperArm")
        return unit_vectors(high - self.place("leftUpperLeg") - self.place("rightUpperLeg"))

    def left(self) -> Float[Tensor, "poses 3"]:
        """Return the unit vector from the right thigh to the left, square to `up`; by the upper arms where thighs are
        one."""
        across = self.place("leftUpperLeg") - self.place("rightUpperLeg")
        arms = self.place("leftUpperArm") - self.place("rightUpperArm")
        across = torch.where(across.norm(dim=-1, keepdim=True) > 1e-3, across, arms)
        return unit_vectors(across - self.up() * (across * self.up()).sum(-1, keepdim=True))

    def toes(self) -> Float[Tensor, "poses 3"]:
        """Return the unit vector from the feet to the toes or the feet's End Sites; zero where there are none."""
        feet = [self.bone(side + "Foot") for side in ("left", "right")]
        return unit_vectors(sum((foot for foot in feet if foot is not None), torch.zeros_like(self.positions[:, 0])))

    def bone(self, name: str) -> Float[Tensor, "poses 3"] | None:
        """Return the vector, metres, from a canonical joint to the next one of its limb or trunk that the rig has, or
        to its End Site; None where the rig lacks either end."""
        if not self.has(name):
            return None
        following = next_joint(name)
        while following is not None and not self.has(following):
            following = next_joint(following)
        stop = self.end(name) if following is None else self.place(following)
        return None if stop is None else stop - self.place(name)

    def handedness(self) -> Float[Tensor, " poses"]:
        """Return the triple product left x up . toes: 1 where sides are as named, -1 where they are exchanged."""
        toes, up = self.toes(), self.up()
        return (torch.linalg.cross(self.left(), up) * toes).sum(-1)


def next_joint(name: str) -> str | None:
    """Return the canonical joint that a bone leads to: the knee for the thigh; None for hips and ends of limbs."""
    below = {"spine": "chest", "chest": "neck", "neck": "head"}
    if name in ("hips", *below):
        return below.get(name)
    children = CANONICAL.children(CANONICAL.index(name))
    return CANONICAL.names[children[0]] if children else None


def are_sides_swapped(zero: RigPoses, clip: RigPoses | None) -> bool:
    """Return whether the joints named left are on the right, judged by the direction of the toes."""
    rest = float(zero.handedness()[0])
    if abs(rest) > _MIN_HANDEDNESS:
        return rest < 0
    return clip is not None and float(clip.handedness().median()) < -_MIN_HANDEDNESS


def find_up_axis(zero: RigPoses, clip: RigPoses | None) -> str:
    """Find the up axis, Y or Z, by the body in the clip, else in the zero pose; Y where neither is conclusive.

    A clip overrules the zero pose only if the body is upright along the other axis in all of its frames, since people
    lie down, too.
    """
    rest = "z" if float(zero.up()[0, 2]) > _UPRIGHT_COSINE else "y"
    if clip is None:
        return rest
    tall = clip.up()
    if rest == "y":
        return "z" if float(tall[:, 2].min()) > 0.5 and float(tall[:, 2].mean()) > _UPRIGHT_COSINE else "y"
    return "y" if float(tall[:, 1].min()) > 0.5 and float(tall[:, 1].mean()) > _UPRIGHT_COSINE else "z"


def unit_vectors(vectors: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
    """Scale vectors to length 1; a vanishing one stays zero."""
    return torch.nn.functional.normalize(vectors, dim=-1, eps=1e-9)
