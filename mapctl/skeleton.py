"""Skeletons: joint names, the tree, and bone offsets; and the canonical one that priors speak."""

import math
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from functools import lru_cache

import torch
from jaxtyping import Float
from torch import Tensor

from mapctl.errors import MapctlError
from mapctl.joint_names import describe_nearest


@dataclass(frozen=True, eq=False, repr=False)
class Skeleton:
    """A tree of joints. Joint 0 is the root and every parent precedes its children."""

    names: tuple[str, ...]
    """Joint names, unique."""
    parents: tuple[int, ...]
    """Index of each joint's parent; -1 for the root."""
    offsets: Float[Tensor, "joints 3"]
    """Each joint in its parent's frame, metres, float64."""
    end_offsets: Mapping[str, tuple[float, float, float]] = field(default_factory=dict)
    """End Sites: joint name to the site's offset in that joint's frame, metres."""

    def __post_init__(self):
        if len(set(self.names)) != len(self.names):
            raise MapctlError(f"joint names must be unique, got {', '.join(self.names)}")
        if self.parents[0] != -1 or any(not 0 <= p < j for j, p in enumerate(self.parents) if j):
            raise MapctlError("joint 0 must be the root and every parent must precede its children")
        if tuple(self.offsets.shape) != (len(self.names), 3):
            raise MapctlError(f"{len(self.names)} joints need offsets of shape ({len(self.names)}, 3)")

    def __str__(self) -> str:
        kind = "canonical joints" if self.names == CANONICAL.names else "joint" if self.num_joints == 1 else "joints"
        # The largest extent along an axis with all rotations zero, End Sites included.
        positions = [self.offsets[0]]
        for joint in range(1, self.num_joints):
            positions.append(positions[self.parents[joint]] + self.offsets[joint])
        ends = [positions[self.index(name)] + self.offsets.new_tensor(end) for name, end in self.end_offsets.items()]
        spread = torch.stack([*positions, *ends])
        extent = float((spread.amax(dim=0) - spread.amin(dim=0)).max())
        return f"Skeleton: {self.num_joints} {kind}, root {self.names[0]}, {extent:.2f} m across at rest"

    def __repr__(self) -> str:
        return f"<{self}>"

    @property
    def num_joints(self) -> int:
        """Number of joints."""
        return len(self.names)

    def index(self, name: str) -> int:
        """Return the joint's index; MapctlError names the nearest joints if there is none."""
        try:
            return self.names.index(name)
        except ValueError:
            raise MapctlError(f"no joint {name!r}; {describe_nearest(name, self.names)}") from None

    def indices(self, names: Iterable[str]) -> list[int]:
        """Return the joints' indices; MapctlError as `index`."""
        return [self.index(name) for name in names]

    def matches(self, other: "Skeleton", tolerance: float = 1e-6) -> bool:
        """Return whether joints, tree and bone offsets (within `tolerance` metres) are the same."""
        same_tree = self.names == other.names and self.parents == other.parents
        return same_tree and bool(torch.allclose(self.offsets, other.offsets, atol=tolerance, rtol=0))

    def mirror_partners(self) -> list[int]:
        """Return by joint the index of its mirror image; itself in the middle of the body.

        Sides are read from the canonical `left` and `right` alone. MapctlError for a skeleton without sides, with
        other names for them (such joints would pass for the middle), or without a partner.
        """
        foreign = [name for name in self.names if mirror_name(name) == name and _FOREIGN_SIDE_NAMES.search(name)]
        if foreign or all(mirror_name(name) == name for name in self.names):
            some = ", ".join((foreign or self.names)[:3])
            raise MapctlError(f"cannot tell left from right by the joints {some}; use retarget.to_canonical first")
        return [self.index(mirror_name(name)) for name in self.names]

    def children(self, joint: int) -> list[int]:
        """Return indices of the joint's children."""
        return [j for j, parent in enumerate(self.parents) if parent == joint]


# Bones of the canonical skeleton: joint, parent, offset in centimetres in the T-pose, facing +Z, left toward +X.
# The lengths are those of the Bandai Namco performer, so that the bundled prior needs no rescaling. Its feet stand
# flat with the ankle 11.74 cm and the toe joint 4.25 cm above the floor (1st percentiles over its walks).
_LEFT_ARM = (
    ("Shoulder", "chest", (4.98, 12.99, -0.24)),
    ("UpperArm", "Shoulder", (5.35, 0, 0)),
    ("LowerArm", "UpperArm", (24.33, 0, 0)),
    ("Hand", "LowerArm", (22.29, 0, 0)),
)
_LEFT_LEG = (
    ("UpperLeg", "hips", (6.47, -2.19, 0)),
    ("LowerLeg", "UpperLeg", (0, -39.08, 0)),
    ("Foot", "LowerLeg", (0, -40.99, 0)),
    ("Toes", "Foot", (0, -7.49, 9.06)),
)
_SPINE = (
    ("hips", "", (0, 0, 0)),
    ("spine", "hips", (0, 15.74, 0)),
    ("chest", "spine", (0, 8.98, -0.41)),
    ("neck", "chest", (0, 16.38, 0)),
    ("head", "neck", (0, 6.46, 0)),
)
_ENDS = {
    "head": (0.0, 0.17, 0.0),
    "leftHand": (0.17, 0.0, 0.0),
    "rightHand": (-0.17, 0.0, 0.0),
    "leftToes": (0.0, -0.01, 0.07),
    "rightToes": (0.0, -0.01, 0.07),
}


def _build_canonical() -> Skeleton:
    bones: list[tuple[str, str, tuple[float, float, float]]] = list(_SPINE)
    for side, sign in (("left", 1), ("right", -1)):
        for limb in (_LEFT_ARM, _LEFT_LEG):
            for name, parent, (x, y, z) in limb:
                bones.append((side + name, parent if parent in ("hips", "chest") else side + parent, (sign * x, y, z)))
    names = tuple(name for name, _, _ in bones)
    parents = tuple(names.index(parent) if parent else -1 for _, parent, _ in bones)
    offsets = torch.tensor([offset for _, _, offset in bones], dtype=torch.float64) / 100
    return Skeleton(names, parents, offsets, _ENDS)


CANONICAL = _build_canonical()
"""The skeleton that priors know: 21 joints with VRM's names, in the size of the performer of the bundled priors'
data."""
# How other rigs name sides: Hand_R, Bip01 L Hand, LeftHand, rHand, RHand, footleft.
_FOREIGN_SIDE_NAMES = re.compile(
    r"(?i:(?:^|[^a-z0-9])(?:l|r|left|right)(?:$|[^a-z0-9]))|Left|Right|^[lrLR](?=[A-Z][a-z])|(?i:left|right)$"
)
TOE_REST_HEIGHT = 0.0425
"""Height of the canonical toe joints over the floor while the foot is flat on it, metres."""
TOES = ("leftToes", "rightToes")
"""Canonical toe joints, in the order of the two contact bits."""
TOE_JOINTS = (CANONICAL.index(TOES[0]), CANONICAL.index(TOES[1]))
"""Indices of the canonical toe joints."""
FEET = ("leftFoot", "rightFoot")
"""Canonical foot joints (ankles), in the order of the toes."""


_HEEL_BELOW_TOES, _HEEL_BEHIND = 0.0201, 0.05  # metres below the toe joint of a flat foot, and behind the foot joint
_FOOT_LENGTH = math.hypot(0.0749, 0.0906)  # metres, from the canonical foot joint to the toe joint


@lru_cache(maxsize=16)
def find_heels(skeleton: Skeleton) -> Float[Tensor, "2 3"]:
    """Find the left and the right heel in the frames of the foot joints, metres, float64; canonical names.

    No rig has a joint there. Lengths are scaled by the foot bone's; the foot is flat while its frame is aligned with
    the world. On walks, turns and runs of mocap the point stands still while the foot is flat.
    """
    toe = skeleton.offsets[skeleton.indices(TOES)].double()
    scale = toe.norm(dim=-1, keepdim=True) / _FOOT_LENGTH
    forward = toe * toe.new_tensor([1.0, 0.0, 1.0])
    forward = forward / forward.norm(dim=-1, keepdim=True).clamp_min(1e-6)
    back = -_HEEL_BEHIND * scale * forward
    return torch.cat([back[..., :1], toe[..., 1:2] - _HEEL_BELOW_TOES * scale, back[..., 2:]], dim=-1)


@lru_cache(maxsize=16)
def find_heel_drops(skeleton: Skeleton) -> tuple[float, float]:
    """Find how far the left and the right heel are below the toe joint while the foot is flat, metres."""
    left, right = (skeleton.offsets[skeleton.indices(TOES)].double() - find_heels(skeleton))[:, 1].tolist()
    return left, right


@dataclass(frozen=True)
class Limb:
    """Two bones and the effector at their end: an arm or a leg."""

    upper: int
    """Joint at which it begins."""
    lower: int
    """Elbow or knee, the only child of `upper`."""
    end: int
    """Hand or foot, the only child of `lower`."""
    bend_direction: tuple[float, float, float]
    """Direction in which the elbow or the knee of a straight limb would bend, in the frame of `upper`."""
    shown: bool = True
    """Whether the initial motion shows how the limb bends; if not, only the proposed elbow or knee does."""

    def length(self, skeleton: Skeleton) -> float:
        """Return the length of a stretched limb of canonical joints, from its first joint to its effector, metres."""
        return float(skeleton.offsets[[self.lower, self.end]].norm(dim=-1).sum())


_KNEE, _ELBOW = (0.0, 0.0, 1.0), (0.0, 0.0, -1.0)
LIMBS = {
    side + end: Limb(*(CANONICAL.index(side + part) for part in (upper, lower, end)), bend_direction=bends)
    for upper, lower, end, bends in (("UpperArm", "LowerArm", "Hand", _ELBOW), ("UpperLeg", "LowerLeg", "Foot", _KNEE))
    for side in ("left", "right")
}
"""Canonical arms and legs by the name of their effectors; knees go forward and elbows back."""


def leg_length(skeleton: Skeleton) -> float:
    """Return the length of the bones from the left hip to the ankle of canonical joints, metres."""
    return LIMBS["leftFoot"].length(skeleton)


def mirror_name(name: str) -> str:
    """Return the joint of the other side: `leftHand` for `rightHand`; other names are their own mirror image."""
    for side, other in (("left", "right"), ("right", "left")):
        if name.startswith(side):
            return other + name[len(side) :]
    return name
