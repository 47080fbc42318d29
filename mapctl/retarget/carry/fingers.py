"""Fingers, which no canonical joint has: on a rig that has the same ones they turn as the giver's."""

import re
from collections import defaultdict
from collections.abc import Mapping

from jaxtyping import Float
from torch import Tensor

from mapctl import rotations
from mapctl.joint_names import Part, Side, classify_joint
from mapctl.motion import Motion
from mapctl.retarget import RigMap
from mapctl.skeleton import Skeleton

_FINGERS = re.compile(r"thumb|index|mid|ring|pinky|little", re.IGNORECASE)
_SAME = {"little": "pinky"}

Finger = tuple[Side, str, int]
"""Side, finger and the number of the joint along it, from 0."""


def match_fingers(giver: Skeleton, body: Skeleton) -> dict[int, int]:
    """Match finger joints by side, finger and place along it: a joint of the giver by joint of the body."""
    theirs = _list_fingers(giver)
    return {joint: theirs[finger] for finger, joint in _list_fingers(body).items() if finger in theirs}


def carry_fingers(clip: Motion, giver: RigMap, body: RigMap) -> Mapping[int, Float[Tensor, "frames 4"]]:
    """Return the local rotations (xyzw) of the body's finger joints that turn as the giver's do, by joint of its rig.

    In the T-poses of both rigs, fingers are taken to point the same way.
    """
    pairs = match_fingers(giver.rig_skeleton, body.rig_skeleton)
    ours, theirs = body.rest_quat_xyzw, giver.rest_quat_xyzw
    found = {}
    for joint, other in pairs.items():
        rest, their_rest = ours[body.rig_skeleton.parents[joint]], theirs[giver.rig_skeleton.parents[other]]
        idle, their_idle = body.idle_quat_xyzw[joint], giver.idle_quat_xyzw[other]
        # From the parent's frame in one T-pose to that in the other; each rotation is what it adds to rest.
        turn = rotations.multiply(rotations.inverse(rest), their_rest).expand(clip.num_frames, 4)
        added = rotations.multiply(clip.local_quat_xyzw[:, other], rotations.inverse(their_idle).expand_as(turn))
        added = rotations.multiply(rotations.multiply(turn, added), rotations.inverse(turn))
        found[joint] = rotations.multiply(added, idle.expand_as(turn))
    return found


def _list_fingers(skeleton: Skeleton) -> dict[Finger, int]:
    chains: dict[tuple[Side, str], list[int]] = defaultdict(list)
    for joint, name in enumerate(skeleton.names):
        role, finger = classify_joint(name), _FINGERS.search(name)
        if role.part is Part.FINGER and role.side is not Side.MIDDLE and finger:
            word = finger[0].lower()
            chains[role.side, _SAME.get(word, word)].append(joint)
    return {(*chain, k): joint for chain, joints in chains.items() for k, joint in enumerate(joints)}
