"""Whether a skeleton is one two-legged body: four legs, a second body, or a second pair of arms."""

import re
from collections.abc import Mapping

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mapctl.retarget.rig_poses import RigPoses, unit_vectors
from mapctl.retarget.topology import JointTree, ancestors, descendants, match_by_tree, path_below
from mapctl.skeleton import Skeleton

_ANIMAL = re.compile(
    r"(?<![A-Za-z])(paw|hoof|hock|fetlock)|Paw|Hoof|Hock|Fetlock|[Ff]ore_?[Ll]eg"
    r"|(?i:(front|hind|rear)_?(left_?|right_?|[lr]_?)?(up|low|leg|limb|thigh))"
)
"""In names of joints; people have a hindfoot and a forefoot, too."""
_MIN_ANIMAL = 2  # joints named as an animal's, from which it is one
_SQUARE = 0.5  # cosine between trunk and legs, below which the trunk lies across them
_ALONG = 0.7  # cosine between arms and legs, above which the arms stand beside the legs
_DEPTH = 0.7  # of the feet under the hips, from which hands are on the ground as well
_STANDS = -0.7  # cosine between trunk and legs, below which somebody stands upright
_MOST = 0.95  # share of a clip's frames on all fours that shows it, where the rest pose does not
_APART = 0.1  # metres between the hips of two bodies
_LIMB_SHARE = 0.7  # of an arm's length, from which another pair of limbs is one


def goes_on_four_legs(skeleton: Skeleton, zero: RigPoses, clip: RigPoses | None) -> bool:
    """Return whether the body is a four-legged one: by its joints' names, or by a trunk across four parallel limbs.

    The pose with all rotations zero tells where it is one; a clip in which the body stands upright overrules it.
    """
    if sum(bool(_ANIMAL.search(name)) for name in skeleton.names) >= _MIN_ANIMAL:
        return True
    if clip is not None and bool((_trunk_against_legs(clip) < _STANDS).any()):
        return False
    return bool(_is_on_all_fours(zero)[0])


def stays_on_all_fours(clip: RigPoses) -> bool:
    """Return whether the body has hands beside its feet under a level trunk in nearly all frames."""
    return float(_is_on_all_fours(clip).double().mean()) >= _MOST


def find_second_body(poses: RigPoses, joints: Mapping[str, int]) -> int | None:
    """Find the hips of another body in the file than the one that is matched, by its tree; None where there is none.

    A second set of joints in the same place, as the controls of a rig are, is no other body.
    """
    skeleton = poses.skeleton
    near = descendants(skeleton, joints.values()) | ancestors(skeleton, joints.values())
    rest = [joint for joint in range(skeleton.num_joints) if joint not in near]
    place = {joint: number for number, joint in enumerate([-1, *rest])}
    parents = (-1, *(place.get(skeleton.parents[joint], 0) for joint in rest))
    offsets = torch.cat([torch.zeros(1, 3, dtype=skeleton.offsets.dtype), skeleton.offsets[rest]])
    ends = {name: end for name, end in skeleton.end_offsets.items() if skeleton.index(name) in place}
    other = match_by_tree(Skeleton(("", *(skeleton.names[j] for j in rest)), parents, offsets, ends))
    if "hips" not in other or other["hips"] == 0:
        return None
    hips = rest[other["hips"] - 1]
    apart = (poses.positions[:, hips] - poses.positions[:, joints["hips"]]).norm(dim=-1).mean()
    return hips if float(apart) > _APART else None


def find_further_limbs(skeleton: Skeleton, joints: Mapping[str, int]) -> tuple[int, int] | None:
    """Find a pair of limbs as long as the arms that hangs from the trunk beside arms and legs; None where none does."""
    trunk = [joints[name] for name in ("hips", "spine", "chest", "neck") if name in joints]
    inside = {joint for joint in descendants(skeleton, {joints["hips"]}) if descendants(skeleton, {joint}) & {*trunk}}
    limbs = {joint for name, joint in joints.items() if joint not in trunk and name != "head"}
    arm = path_below(skeleton, joints["leftUpperArm"], joints.get("leftHand", joints["leftLowerArm"]))
    tree, least = JointTree(skeleton), _LIMB_SHARE * float(skeleton.offsets[arm].norm(dim=-1).sum())
    for joint in sorted({*trunk, *inside}):
        for first, second in tree.find_limb_pairs(joint):
            long = sum(tree.length[below] for below in first[1:]) >= least
            if long and not descendants(skeleton, {first[0], second[0]}) & limbs:
                return first[0], second[0]
    return None


def _is_on_all_fours(poses: RigPoses) -> Bool[Tensor, " poses"]:
    """Return whether the trunk lies across parallel arms and legs, and the hands are about as far down as the feet,
    which those of a crouching person are not."""
    legs, arms = _limbs(poses, "Leg"), _limbs(poses, "Arm")
    front = "Hand" if poses.has("leftHand", "rightHand") else "LowerArm"
    depth = [((poses.middle(part) - poses.middle("UpperLeg")) * legs).sum(-1) for part in (front, "Foot")]
    square = (_trunk_against_legs(poses).abs() < _SQUARE) & ((legs * arms).sum(-1) > _ALONG)
    return square & (depth[0] > _DEPTH * depth[1])


def _trunk_against_legs(poses: RigPoses) -> Float[Tensor, " poses"]:
    """Return the cosine between trunk and legs: -1 where somebody stands upright."""
    return (poses.up() * _limbs(poses, "Leg")).sum(-1)


def _limbs(poses: RigPoses, part: str) -> Float[Tensor, "poses 3"]:
    """Return the mean direction of both upper and lower limbs of a kind, downward along them."""
    bones = [poses.bone(f"{side}{half}{part}") for side in ("left", "right") for half in ("Upper", "Lower")]
    return unit_vectors(sum((bone for bone in bones if bone is not None), torch.zeros_like(poses.positions[:, 0])))
