"""Retargeting: motion of one performer on the bones of another, with the same contacts.

Rotations stay, but of legs, and of arms whose hands are near something. The hips go as far and as high as the legs'
lengths and the ground ask for, each toe joint is as high over its own rest height as the giver's over his, in scale,
and while a foot is planted it moves as little as the giver's. Hands near the body, each other or the floor are brought
where they were relative to these. Two-bone inverse kinematics brings legs and arms there. (The footsteps are kept as
in Gleicher 1998, but joint by joint instead of by spacetime optimisation.)
"""

import re
from collections import defaultdict
from collections.abc import Mapping
from dataclasses import replace
from typing import Literal, get_args

from jaxtyping import Float
from torch import Tensor

from mapctl import rotations
from mapctl.errors import RequestError
from mapctl.joint_names import Part, Side, classify_joint
from mapctl.motion import Motion
from mapctl.retarget import RigMap, as_rig, to_canonical
from mapctl.retarget.carry import legs
from mapctl.retarget.carry.changes import Changes, RetargetedMotion, list_unmatched_joints, measure_changes
from mapctl.retarget.carry.character import LEGS, RiggedCharacter, limb_extension
from mapctl.retarget.carry.hands import keep_hand_relations
from mapctl.retarget.rigs import Rig
from mapctl.skeleton import Skeleton, leg_length

__all__ = ["Changes", "GroundMode", "RetargetedMotion", "RiggedCharacter", "retarget_canonical", "retarget_motion"]

GroundMode = Literal["fit", "keep"]
"""Whether what feet stand on, as stairs, is scaled with the body (`fit`) or as high as it was, in metres (`keep`)."""
_FINGERS = re.compile(r"thumb|index|mid|ring|pinky|little", re.IGNORECASE)
_SAME = {"little": "pinky"}


def retarget_motion(
    clip: Motion, body: RiggedCharacter, rig: Rig | None = None, *, ground: GroundMode = "fit"
) -> RetargetedMotion:
    """Retarget a clip of any rig to a body's bones, in the canonical joint frames of its rig.

    A clip of the body's own skeleton comes as it is, to the bit. `rig` is the clip's, where it is not the one that
    would be recognised. `ground`: see `GroundMode`. RequestError where the clip's joints cannot be identified, or for
    another `ground`.
    """
    if clip.skeleton.matches(body.rigmap.rig_skeleton):
        return RetargetedMotion(replace(to_canonical(clip, as_rig(body.rigmap))[0], skeleton=body.skeleton))
    canonical, giver = RiggedCharacter.of(clip, rig)
    found = retarget_canonical(canonical, giver, body, ground=ground)
    fingers = match_fingers(clip.skeleton, body.rigmap.rig_skeleton)
    unmatched = list_unmatched_joints(clip, giver.rigmap, fingers.values())
    carried = _carry_fingers(clip, giver.rigmap, body.rigmap, fingers)
    return replace(found, changes=replace(found.changes, unmatched_joints=unmatched), fingers=carried)


def retarget_canonical(
    motion: Motion, giver: RiggedCharacter, body: RiggedCharacter, *, ground: GroundMode = "fit"
) -> RetargetedMotion:
    """Retarget a motion (canonical joints, any part of a clip) whose giver is known. RequestError for another `ground`
    than those of `GroundMode`."""
    if ground not in get_args(GroundMode):
        raise RequestError(f"the ground is one of {', '.join(get_args(GroundMode))}, got {ground!r}")
    keeps = ground == "keep"
    giver = replace(giver, stance=giver.stance.keep_floor()) if keeps else giver
    own = giver.stance.leveled(motion)
    scale = leg_length(body.leveled) / leg_length(own.skeleton)
    found = legs.find_ground(own, giver.stance)
    higher = 1 - scale if keeps else 0.0
    moved = legs.transfer_root(own, giver, body, scale, higher * found.under_hips(float(own.fps)))
    raised = higher * found.height
    ankles = legs.find_ankle_targets(own, moved, giver.stance, body.stance, found, scale=scale, raised=raised)
    straight = limb_extension(own, LEGS)
    lowered = legs.lower_hips(legs.fit_hips(moved, ankles, straight), ankles, straight)
    standing = legs.reach_ankle_targets(lowered, ankles)
    done, hands = keep_hand_relations(own, standing, giver.stance, scale=scale)
    changes = measure_changes(
        motion, done, ankles, hands, dip=moved.root_position - lowered.root_position, tilt=giver.stance.tilt
    )
    return RetargetedMotion(body.stance.restore_foot_tilt(done), changes)


def match_fingers(giver: Skeleton, body: Skeleton) -> dict[int, int]:
    """Match finger joints by side, finger and place along it: a joint of the giver by joint of the body."""
    theirs = _list_fingers(giver)
    return {joint: theirs[finger] for finger, joint in _list_fingers(body).items() if finger in theirs}


def _carry_fingers(
    clip: Motion, giver: RigMap, body: RigMap, pairs: Mapping[int, int]
) -> Mapping[int, Float[Tensor, "frames 4"]]:
    """Return the local rotations (xyzw) of the body's finger joints that turn as the giver's do, by joint of its rig;
    in the T-poses of both rigs, fingers are taken to point along the same direction."""
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


def _list_fingers(skeleton: Skeleton) -> dict[tuple[Side, str, int], int]:
    """List finger joints by side, finger and number along it, from 0."""
    chains: dict[tuple[Side, str], list[int]] = defaultdict(list)
    for joint, name in enumerate(skeleton.names):
        role, finger = classify_joint(name), _FINGERS.search(name)
        if role.part is Part.FINGER and role.side is not Side.MIDDLE and finger:
            word = finger[0].lower()
            chains[role.side, _SAME.get(word, word)].append(joint)
    return {(*chain, k): joint for chain, joints in chains.items() for k, joint in enumerate(joints)}
