"""Retargeting: motion of one performer on the bones of another, with the same contacts.

Rotations stay, but of legs, and of arms whose hands are near something. Hips follow the source's trajectory in scale,
as high as legs and ground ask for; each toe joint is as high over its own rest height as the source's over his, in
scale, and a planted foot moves as little as the source's. Hands near the body, each other or the floor are brought
where they were relative to these. Two-bone inverse kinematics brings legs and arms there. (The footsteps are kept as in
Gleicher 1998, but joint by joint instead of by spacetime optimisation.) What feet stand on is the floor, or what is
higher, as stairs and platforms.
"""

import math
import re
from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Literal, get_args

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mapctl import contacts, kinematics, rotations
from mapctl.errors import RequestError
from mapctl.joint_names import Part, Side, abbreviate_names, classify_joint
from mapctl.kinematics import inverse
from mapctl.motion import Motion
from mapctl.numerics import gaussian
from mapctl.numerics.easing import smootherstep
from mapctl.retarget import RigMap, as_rig, to_canonical
from mapctl.retarget.anatomy import ancestors
from mapctl.retarget.character import (
    FEET,
    HIP_JOINTS,
    LEGS,
    MAX_TOE_SINK,
    SHINS,
    TOES,
    RiggedCharacter,
    Stance,
    limb_extension,
    limb_lengths,
    rotate_foot_frames,
)
from mapctl.retarget.hands import Spans, hold_through, keep_hand_relations, mean_by_span, merge_contacts, soft_clamp
from mapctl.retarget.legs import MAX_EXTENSION, fit_hips, lower_hips
from mapctl.retarget.rigs import Rig
from mapctl.skeleton import Skeleton, leg_length

_FOOT_METRES = 0.005  # metres that a foot misses its target by before it is worth a line
_HAND_METRES = 0.01  # metres that a hand does
_DIP_METRES = 0.05  # metres that hips go lower than in scale before it is worth a line
_MOVES_RADIANS = math.radians(1.0)  # angle within which a joint does not move


@dataclass(frozen=True)
class Miss:
    """How far effectors are from where they should be."""

    metres: float = 0.0
    """The farthest, metres."""
    frame: int = 0
    """Frame in which that is."""
    frames: int = 0
    """Frames in which one is farther off than is worth a line: 0.5 cm for feet, 1 cm for hands."""

    @staticmethod
    def of(off: Float[Tensor, "frames 2"], noted: float) -> "Miss":
        """Measure by how many metres effectors are off, noted from so many metres on."""
        farthest = off.amax(dim=-1)
        return Miss(float(farthest.max()), int(farthest.argmax()), int((farthest > noted).sum()))


@dataclass(frozen=True)
class Changes:
    """Changes by retargeting, beside bones."""

    scale: float = 1.0
    """Length of the body's legs over the source's."""
    hips_lowered_m: float = 0.0
    """How much lower the hips are at most than in scale, metres, for legs that are too short."""
    feet_missed: Miss = Miss()
    """Ankles against their targets."""
    hands_missed: Miss = Miss()
    """Hands that are near something against their targets."""
    unmatched_joints: tuple[str, ...] = ()
    """Joints of the source that move and have no counterpart."""

    @property
    def notes(self) -> tuple[str, ...]:
        """Return sentences about what could not be kept; empty where all is."""
        found = [
            f"the {name} are too short for some of it: {ends} are up to {100 * miss.metres:.1f} cm off (frame"
            f" {miss.frame}), by more than {100 * noted:g} cm in {miss.frames} frames"
            for name, ends, miss, noted in (
                ("legs", "feet", self.feet_missed, _FOOT_METRES),
                ("arms", "hands", self.hands_missed, _HAND_METRES),
            )
            if miss.frames
        ]
        if self.hips_lowered_m >= _DIP_METRES:
            dip = f"{100 * self.hips_lowered_m:.1f} cm"
            found.append(f"the hips are up to {dip} lower than in scale, so that the feet reach")
        if self.unmatched_joints:
            found.append(f"joints without a counterpart are left out: {abbreviate_names(self.unmatched_joints)}")
        return tuple(found)


@dataclass(frozen=True, eq=False)
class RetargetedMotion:
    """A motion on another body."""

    motion: Motion
    """On canonical joints, with the bones of the body."""
    changes: Changes = Changes()
    fingers: Mapping[int, Float[Tensor, "frames 4"]] = field(default_factory=dict)
    """Local rotations (xyzw) of the body's finger joints that turn as the source's, by joint of its rig."""


_SMOOTH_SECONDS = 0.05  # seconds over which what hips carry is smoothed
_UP = torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64)
_SOFT_MARGIN = 0.004  # of the leg, before the most that it may be, over which it gives in
_HEEL_DEG, _MAX_HEEL_DEG = 10.0, 60.0  # degrees that toes are raised by when a foot is on its heel, and at most
# Heights over the ground, of the leg: from the first on rotations count, from the second on they alone do.
_LOW_SHARE, _HIGH_SHARE = 0.1, 0.35
_FREE_SECONDS = 0.25  # seconds over which the shift of feet that never stand is smoothed
# Standing above the floor means a still, level foot for a while, with the hips well over it.
_RAISED_METRES = 0.05  # metres over the floor from which the ground is no floor
_STILL_SPEED, _STILL_SECONDS = 0.3, 0.2  # m/s in space below which a toe is still, and for how long
_SPEED_SECONDS = 0.1  # seconds over which that speed is the mean, or a capture's noise looks like motion
_LEVEL_DEG = 20.0  # degrees that a level foot is off
_HIPS_SHARE = 0.5  # of the leg, that hips are over a foot that bears them
_BODY_SECONDS = 0.2  # seconds over which the ground under the hips is smoothed


def find_ground(own: Motion, stance: Stance) -> tuple[list[Spans], Float[Tensor, "frames 2"]]:
    """Find what the left and the right foot of a clip stand on (canonical joints, feet level in the T-pose).

    Return the contacts of each, and the height over the clip's floor of what it stands on, metres; between two contacts
    smoothly from one to the other.
    """
    toes, frames = own.joint_positions()[:, TOES], own.num_frames
    over = toes[..., 1] - stance.floor - stance.flat_height
    bearing = _detect_bearing(own)
    spans = merge_contacts(contacts.detect_contacts(toes, own.fps) | bearing, toes, float(own.fps))
    heights = torch.zeros(frames, 2, dtype=torch.float64)
    for k, of_foot in enumerate(spans):
        if of_foot:
            means, bears = (mean_by_span(v[:, k, None], of_foot) for v in (over, bearing.double()))
            raised = torch.where((bears > 0.5) & (means > _RAISED_METRES), means, 0.0)
            heights[:, k] = hold_through(of_foot, raised, frames)[:, 0]
    return spans, heights


def _detect_bearing(own: Motion) -> Bool[Tensor, "frames 2"]:
    """Detect feet that bear the body, at any height: higher than the floor, or on a floor that drifts with the take."""
    positions, fps = own.joint_positions(), float(own.fps)
    step = max(1, round(_SPEED_SECONDS * fps))
    if own.num_frames <= step:
        return torch.zeros(own.num_frames, 2, dtype=torch.bool)
    speed = (positions[step:, TOES] - positions[:-step, TOES]).norm(dim=-1) * (fps / step)
    before = step // 2  # a frame's speed is that of the time around it
    speed = torch.cat([speed[:1].expand(before, 2), speed, speed[-1:].expand(step - before, 2)])
    forward = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    slope = rotations.rotate(own.joint_rotations()[:, FEET], forward)[..., 1].abs()
    bears = positions[:, HIP_JOINTS, 1] - positions[:, TOES, 1] > _HIPS_SHARE * leg_length(own.skeleton)
    level = slope < math.sin(math.radians(_LEVEL_DEG))
    still = (speed < _STILL_SPEED) & level & bears
    return contacts.remove_short_runs(still, max(1, round(_STILL_SECONDS * fps)))


def _transfer_root(
    own: Motion, source: RiggedCharacter, body: RiggedCharacter, scale: float, raised: Float[Tensor, " frames"]
) -> Motion:
    """Put the source's rotations on the body's bones. The middle between the thighs follows its trajectory in scale, as
    much higher as ankles, floor and `raised` (metres, by what the ground is kept higher than in scale) ask for."""
    to_thighs = body.leveled.offsets[HIP_JOINTS].mean(0) - scale * own.skeleton.offsets[HIP_JOINTS].mean(0)
    turns = own.joint_rotations()[:, 0]
    # The hips' rotation is noisy; what they carry at another distance is not to shake for it.
    aside = gaussian.smooth(rotations.rotate(turns, to_thighs), _SMOOTH_SECONDS * float(own.fps))
    # Ankles over the floor while feet lie flat, mean of both.
    ankle = (body.stance.standing_height - body.leveled.offsets[TOES, 1]).mean()
    others = (source.stance.flat_height - own.skeleton.offsets[TOES, 1]).mean()
    rise = _UP * (ankle - scale * others + (1 - scale) * source.stance.floor + raised)[:, None]
    return replace(own, skeleton=body.leveled, root_position=scale * own.root_position + rise - aside, source=None)


def _find_ankle_targets(
    own: Motion,
    moved: Motion,
    source: Stance,
    body: Stance,
    spans: list[Spans],
    ground: Float[Tensor, "frames 2"],
    raised: Float[Tensor, "frames 2"],
    *,
    scale: float,
) -> Float[Tensor, "frames 2 3"]:
    """Return target ankle positions, metres: toe joints as the source's in scale, over their own rest heights, and
    moved over the ground to where the body's rotations bring them, by as much throughout a contact. High over the
    `ground` (metres, in scale) rotations alone count: a kick is a pose, not a position. `raised` is by how much the
    ground is kept higher than in scale, metres."""
    toes, positions = own.joint_positions()[:, TOES], scale * own.joint_positions()[:, FEET]
    aside = (moved.joint_positions()[:, TOES] - scale * toes)[..., ::2]
    for k, of_foot in enumerate(spans):
        if of_foot:
            positions[:, k, ::2] += hold_through(of_foot, mean_by_span(aside[:, k], of_foot), len(toes))
        else:
            positions[:, k, ::2] += gaussian.smooth(aside[:, k], _FREE_SECONDS * float(own.fps))
    over = scale * (toes[..., 1] - source.floor - source.flat_height)
    lifted = torch.where(over < 0, MAX_TOE_SINK * torch.expm1(over / MAX_TOE_SINK) - over, 0.0)
    positions[..., 1] += (
        (1 - scale) * source.floor + body.standing_height - scale * source.flat_height + lifted + raised
    )
    share = (over - ground) / leg_length(moved.skeleton)
    high = smootherstep((share - _LOW_SHARE) / _HIGH_SHARE)[..., None]
    return torch.lerp(positions + _foot_length_offset(own, moved, scale), moved.joint_positions()[:, FEET], high)


def _foot_length_offset(own: Motion, moved: Motion, scale: float) -> Float[Tensor, "frames 2 3"]:
    """Return the offset of the ankle from where it would be if the foot were the source's in scale, metres.

    A foot whose heel is raised pivots on its toes, one whose toes are raised on its heel, right below the ankle: then
    the ankle follows the source's trajectory, as if the foot were flat.
    """
    longer = (scale * own.skeleton.offsets - moved.skeleton.offsets)[TOES]
    turns = own.joint_rotations()[:, FEET]
    heading, tilt = rotations.split_heading(turns)
    forward = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    rises = (rotations.rotate(turns, axis)[..., 1] for axis in (forward, forward.roll(-1, -1)))
    up = torch.rad2deg(torch.atan2(*rises))
    on_toes = 1 - smootherstep(up / _HEEL_DEG) * (1 - smootherstep((up - _MAX_HEEL_DEG) / _MAX_HEEL_DEG))
    still = torch.tensor([0.0, 0.0, 0.0, 1.0], dtype=torch.float64).expand_as(tilt)
    tilt = rotations.slerp(still, tilt, on_toes)
    return rotations.rotate(rotations.multiply(rotations.about_y(heading), tilt), longer)


def reach_ankle_targets(moved: Motion, ankles: Float[Tensor, "frames 2 3"]) -> Motion:
    """Bend and rotate legs so that ankles reach their targets; feet keep their orientation in the world."""
    positions, world = moved.joint_positions().clone(), moved.joint_rotations()
    at, most = positions[:, HIP_JOINTS], MAX_EXTENSION * limb_lengths(moved.skeleton, LEGS)
    to_ankles = ankles - at
    far = to_ankles.norm(dim=-1)
    positions[:, FEET] = at + to_ankles * (soft_clamp(far, most, _SOFT_MARGIN * most) / far.clamp_min(1e-9))[..., None]
    free = torch.zeros(positions.shape[:2], dtype=torch.bool)
    free[:, [*HIP_JOINTS, *SHINS]] = True
    local = inverse.solve_inverse_kinematics(
        positions, moved.local_quat_xyzw, moved.skeleton, free=free, root_position=moved.root_position, limbs=LEGS
    )
    turned = replace(moved, local_quat_xyzw=local).joint_rotations().clone()
    turned[:, [*FEET, *TOES]] = world[:, [*FEET, *TOES]]
    local = rotations.make_sign_continuous(kinematics.local_from_world(moved.skeleton.parents, turned))
    return replace(moved, local_quat_xyzw=local)


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
    would be recognised. RequestError where the clip's joints cannot be identified, or for another `ground` than those
    of `GroundMode`.
    """
    if clip.skeleton.matches(body.rigmap.rig_skeleton):
        return RetargetedMotion(replace(to_canonical(clip, as_rig(body.rigmap))[0], skeleton=body.skeleton))
    canonical, source = RiggedCharacter.of(clip, rig)
    found = retarget_canonical(canonical, source, body, ground=ground)
    ours, theirs = _list_fingers(body.rigmap.rig_skeleton), _list_fingers(clip.skeleton)
    fingers = {joint: theirs[finger] for finger, joint in ours.items() if finger in theirs}
    # What the turns of joints do that move, are not matched and lead to no joint that is, is lost.
    led_by = ancestors(clip.skeleton, [*source.rigmap.joints.values(), *fingers.values()])
    dots = (clip.local_quat_xyzw * clip.local_quat_xyzw[:1]).sum(-1).abs().amin(dim=0).clamp(max=1.0)
    moves = 2 * torch.acos(dots) > _MOVES_RADIANS
    lost = tuple(name for j, name in enumerate(clip.skeleton.names) if j not in led_by and bool(moves[j]))
    carried = _carry_fingers(clip, source.rigmap, body.rigmap, fingers)
    return replace(found, changes=replace(found.changes, unmatched_joints=lost), fingers=carried)


def retarget_canonical(
    motion: Motion, source: RiggedCharacter, body: RiggedCharacter, *, ground: GroundMode = "fit"
) -> RetargetedMotion:
    """Retarget a motion (canonical joints, any part of a clip) whose source is known. RequestError for another `ground`
    than those of `GroundMode`."""
    if ground not in get_args(GroundMode):
        raise RequestError(f"the ground is one of {', '.join(get_args(GroundMode))}, got {ground!r}")
    if ground == "keep":
        source = replace(source, stance=source.stance.keep_floor(source.skeleton))
    own = rotate_foot_frames(motion, -source.stance.tilt)
    scale = leg_length(body.leveled) / leg_length(own.skeleton)
    spans, height = find_ground(own, source.stance)
    higher = 1 - scale if ground == "keep" else 0.0
    under_hips = gaussian.smooth(height.mean(dim=1, keepdim=True), _BODY_SECONDS * float(own.fps))[:, 0]
    moved = _transfer_root(own, source, body, scale, higher * under_hips)
    grounds = scale * height, higher * height
    ankles = _find_ankle_targets(own, moved, source.stance, body.stance, spans, *grounds, scale=scale)
    straight = limb_extension(own, LEGS)
    lowered = lower_hips(fit_hips(moved, ankles, straight), ankles, straight)
    standing = reach_ankle_targets(lowered, ankles)
    done, hands_off = keep_hand_relations(own, standing, source.stance, scale=scale)
    changes = Changes(
        scale=leg_length(done.skeleton) / leg_length(motion.skeleton),
        hips_lowered_m=max(0.0, float((moved.root_position - lowered.root_position)[:, 1].max())),
        feet_missed=Miss.of((done.joint_positions()[:, FEET] - ankles).norm(dim=-1), _FOOT_METRES),
        hands_missed=Miss.of(hands_off, _HAND_METRES),
    )
    return RetargetedMotion(rotate_foot_frames(done, body.stance.tilt), changes)


def _carry_fingers(
    clip: Motion, source: RigMap, body: RigMap, pairs: Mapping[int, int]
) -> Mapping[int, Float[Tensor, "frames 4"]]:
    """Return local rotations (xyzw) of the body's fingers that turn as the source's, by joint of its rig; in the
    T-poses of both, fingers are taken to point along the same direction."""
    ours, theirs = body.rest_quat_xyzw, source.rest_quat_xyzw
    found = {}
    for joint, other in pairs.items():
        rest, their_rest = ours[body.rig_skeleton.parents[joint]], theirs[source.rig_skeleton.parents[other]]
        idle, their_idle = body.idle_quat_xyzw[joint], source.idle_quat_xyzw[other]
        # From the parent's frame in one T-pose to that in the other; each rotation is what it adds to rest.
        turn = rotations.multiply(rotations.inverse(rest), their_rest)
        added = rotations.multiply(clip.local_quat_xyzw[:, other], rotations.inverse(their_idle))
        added = rotations.multiply(rotations.multiply(turn, added), rotations.inverse(turn))
        found[joint] = rotations.multiply(added, idle)
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
