"""The mirror image of each joint of any rig: canonical joints by what they are, others by name, then by place."""

from collections.abc import Iterator

import torch
from jaxtyping import Float
from torch import Tensor

from mapctl import kinematics
from mapctl.joint_names import Side, normalise_name, split_side
from mapctl.retarget import RigMap
from mapctl.skeleton import mirror_name

_NEAR = 0.02  # metres within which a joint without a side in its name is the mirror image of another at rest


def pair_joints(rigmap: RigMap) -> list[int | None]:
    """Return by joint of the rig the index of its mirror image: itself in the middle of the body, None where it has
    a side but no partner, as a prop in one hand.

    Canonical joints are paired as such. Others are paired by their names without left and right, as
    `mapctl.joint_names` knows these, else by their places in the T-pose below joints that are paired.
    """
    names = rigmap.rig_skeleton.names
    found: dict[int, int] = dict(_pair_canonical(rigmap))
    for joint, partner in _pair_by_name(names):
        if joint not in found and partner not in found:
            found |= {joint: partner, partner: joint}
    places = _rest_positions(rigmap)
    for joint in range(len(names)):  # parents come first
        if joint not in found:
            partner = _pair_by_place(joint, found, rigmap, places)
            found |= {} if partner is None else {joint: partner, partner: joint}
    return [found.get(joint) for joint in range(len(names))]


def _pair_canonical(rigmap: RigMap) -> Iterator[tuple[int, int]]:
    joints = rigmap.joints
    for name, joint in joints.items():
        if mirror_name(name) in joints:
            yield joint, joints[mirror_name(name)]


def _pair_by_name(names: tuple[str, ...]) -> Iterator[tuple[int, int]]:
    sides: dict[Side, dict[str, int]] = {side: {} for side in Side}
    for joint, name in enumerate(names):
        side, rest = split_side(name)
        sides[side].setdefault(normalise_name(rest), joint)
    for rest, joint in sides[Side.LEFT].items():
        if rest in sides[Side.RIGHT]:
            yield joint, sides[Side.RIGHT][rest]


def _pair_by_place(joint: int, found: dict[int, int], rigmap: RigMap, places: Float[Tensor, "joints 3"]) -> int | None:
    skeleton = rigmap.rig_skeleton
    parent = skeleton.parents[joint]
    if parent < 0:
        return joint
    if parent not in found:
        return None
    side = split_side(skeleton.names[joint])[0]
    around = skeleton.children(found[parent])
    # Of a side in the name no partner was found by that name; what has none and is alone in the middle is its own.
    free = [] if side is not Side.MIDDLE else [other for other in around if other not in found]
    mirrored = places[joint] * places.new_tensor([-1.0, 1.0, 1.0])
    near = [(float((places[other] - mirrored).norm()), other) for other in free]
    nearest = min(near, default=None)
    if nearest is not None and nearest[0] < _NEAR:
        return nearest[1]
    return joint if side is Side.MIDDLE and found[parent] == parent else None


def _rest_positions(rigmap: RigMap) -> Float[Tensor, "joints 3"]:
    """Return the joints' places in the T-pose, metres, from the middle of the hips."""
    skeleton, world = rigmap.rig_skeleton, rigmap.rest_quat_xyzw
    local = kinematics.local_from_world(skeleton.parents, world[None])
    places = kinematics.forward_kinematics(skeleton.offsets, skeleton.parents, torch.zeros(1, 3).double(), local)[0][0]
    return places - places[rigmap.joints["hips"]]
