"""Retargeting: motion of one performer on the bones of another, with the same contacts.

Rotations stay, but of legs, and of arms whose hands are near something. The hips go as far and as high as the legs'
lengths and the ground ask for, each toe joint is as high over its own rest height as the giver's over his, in scale,
and while a foot is planted it moves as little as the giver's. Hands near the body, each other or the floor are brought
where they were relative to these. Two-bone inverse kinematics brings legs and arms there. (The footsteps are kept as
in Gleicher 1998, but joint by joint instead of by spacetime optimisation.)
"""

from dataclasses import replace
from typing import Literal, get_args

from mapctl.errors import RequestError
from mapctl.motion import Motion
from mapctl.retarget import as_rig, to_canonical
from mapctl.retarget.carry.changes import Changes, RetargetedMotion, list_unmatched_joints, measure_changes
from mapctl.retarget.carry.character import LEGS, RiggedCharacter, limb_extension
from mapctl.retarget.carry.fingers import carry_fingers, match_fingers
from mapctl.retarget.carry.ground import find_ground
from mapctl.retarget.carry.hands import keep_hand_relations
from mapctl.retarget.carry.legs import find_ankle_targets, fit_hips, lower_hips, reach_ankle_targets, transfer_root
from mapctl.retarget.rigs import Rig
from mapctl.skeleton import leg_length

__all__ = ["Changes", "GroundMode", "RetargetedMotion", "RiggedCharacter", "retarget_canonical", "retarget_motion"]

GroundMode = Literal["fit", "keep"]
"""Whether what feet stand on, as stairs, is scaled with the body (`fit`) or as high as it was, in metres (`keep`)."""


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
    carried = carry_fingers(clip, giver.rigmap, body.rigmap)
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
    found = find_ground(own, giver.stance)
    higher = 1 - scale if keeps else 0.0
    moved = transfer_root(own, giver, body, scale, higher * found.under_hips(float(own.fps)))
    ankles = find_ankle_targets(own, moved, giver.stance, body.stance, found, scale=scale, raised=higher * found.height)
    straight = limb_extension(own, LEGS)
    lowered = lower_hips(fit_hips(moved, ankles, straight), ankles, straight)
    legs = reach_ankle_targets(lowered, ankles)
    done, reached = keep_hand_relations(own, legs, giver.stance, scale=scale)
    changes = measure_changes(
        motion, done, ankles, reached, dip=moved.root_position - lowered.root_position, tilt=giver.stance.tilt
    )
    return RetargetedMotion(body.stance.restore_foot_tilt(done), changes)
