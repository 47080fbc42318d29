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
_UPRIGHT_COSINE = 0.8  # cosine between an axis and the body that stands along it
_MIN_HANDEDNESS = 0.3  # of the triple product left x up x toes, below which toes do not tell the facing

JointOf = Sequence[int | None]
"""For each canonical joint the rig's joint, or None."""


@dataclass(frozen=True, eq=False)
class RigPoses:
    """Poses of one rig in its file's world: frames of a clip, or the single pose with all rotations zero."""

    places: Float[Tensor, "poses joints 3"]
    """World positions, metres."""
    turns: Float[Tensor, "poses joints 4"]
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
        return RigPoses(self.places[:1], self.turns[:1], self.skeleton, self.joint_of)

    def has(self, *names: str) -> bool:
        """Return whether the rig has all these canonical joints."""
        return all(self.joint_of[CANONICAL.index(name)] is not None for name in names)

    def place(self, name: str) -> Float[Tensor, "poses 3"]:
        """Return the position of a canonical joint that the rig has, metres."""
        joint = self.joint_of[CANONICAL.index(name)]
        assert joint is not None
        return self.places[:, joint]

    def end(self, name: str) -> Float[Tensor, "poses 3"] | None:
        """Return the position of the End Site of a canonical joint, metres, if there is one of some length."""
        joint = self.joint_of[CANONICAL.index(name)]
        site = self.skeleton.end_offsets.get(self.skeleton.names[joint]) if joint is not None else None
        if joint is None or site is None or max(map(abs, site)) < 1e-4:
            return None
        offset = torch.tensor(site, dtype=torch.float64).expand(len(self.places), 3)
        return self.places[:, joint] + rotations.rotate(self.turns[:, joint], offset)

    def up(self) -> Float[Tensor, "poses 3"]:
        """Return the unit vector from the thighs to the upper arms."""
        high = self.place("leftUpperArm") + self.place("rightUpperArm")
        return _unit(high - self.place("leftUpperLeg") - self.place("rightUpperLeg"))

    def left(self) -> Float[Tensor, "poses 3"]:
        """Return the unit vector from the right thigh to the left, square to `up`; by the upper arms where thighs are
        one."""
        across = self.place("leftUpperLeg") - self.place("rightUpperLeg")
        arms = self.place("leftUpperArm") - self.place("rightUpperArm")
        across = torch.where(across.norm(dim=-1, keepdim=True) > 1e-3, across, arms)
        return _unit(across - self.up() * (across * self.up()).sum(-1, keepdim=True))

    def toes(self) -> Float[Tensor, "poses 3"]:
        """Return the unit vector from the feet to the toes or the feet's End Sites; zero where there are none."""
        ways = [self.way(side + "Foot") for side in ("left", "right")]
        return _unit(sum((way for way in ways if way is not None), torch.zeros_like(self.places[:, 0])))

    def way(self, name: str) -> Float[Tensor, "poses 3"] | None:
        """Return the vector, metres, from a canonical joint to the next one of its limb or trunk that the rig has, or
        to its End Site.

        None where it lacks one of the two.
        """
        if not self.has(name):
            return None
        following = next_joint(name)
        while following is not None and not self.has(following):
            following = next_joint(following)
        stop = self.end(name) if following is None else self.place(following)
        return None if stop is None else stop - self.place(name)

    def handedness(self) -> Float[Tensor, " poses"]:
        """Return left x up along the toes: 1 where sides are what their names say, -1 where they are exchanged."""
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
    """Find the up axis, Y or Z, of the body in the clip, else in the zero pose; Y where neither tells.

    Against the zero pose, and where that tells nothing, only a clip counts in which the body stands along Z all the
    time: people lie down, too.
    """
    rest = zero.up()[0]
    told = "z" if float(rest[2]) > _UPRIGHT_COSINE else "y"
    if clip is None:
        return told
    tall = clip.up()
    if told == "y":
        return "z" if float(tall[:, 2].min()) > 0.5 and float(tall[:, 2].mean()) > _UPRIGHT_COSINE else "y"
    return "y" if float(tall[:, 1].min()) > 0.5 and float(tall[:, 1].mean()) > _UPRIGHT_COSINE else "z"


def _unit(vectors: Tensor) -> Tensor:
    return torch.nn.functional.normalize(vectors, dim=-1, eps=1e-9)
