"""Left and right exchanged, on any rig, through the plane x = 0 of the world (with Y up).

A joint's rotation in the world, against its own in the T-pose, becomes the mirror image of its partner's:
W' = M W_p R_p^-1 M R, with M the mirror through x = 0 and R the rotations in the T-pose. So the rig keeps its bones,
fingers and twists turn as their partners did, and mirroring twice gives W again.
"""

from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from mapctl import kinematics, rotations
from mapctl.editing.rigged_motion import RiggedMotion, place_ankles
from mapctl.joint_names import Side, normalise_name, split_side
from mapctl.motion import Motion
from mapctl.retarget import RigMap
from mapctl.retarget.rigs import Rig
from mapctl.skeleton import Skeleton, mirror_name

_NEAR = 0.02  # metres within which a joint without a side in its name is the mirror image of another at rest


def pair_joints(rigmap: RigMap) -> list[int | None]:
    """Return by joint of the rig the index of its mirror image: itself in the middle of the body, None where it has
    a side but no partner, as a prop in one hand.

    Canonical joints are paired as such. Others are paired by their names without left and right, as
    `mapctl.joint_names` has these, else by their positions in the T-pose below joints that are paired.
    """
    skeleton, joints = rigmap.rig_skeleton, rigmap.joints
    found = {joint: joints[other] for name, joint in joints.items() if (other := mirror_name(name)) in joints}
    sides: dict[Side, dict[str, int]] = {side: {} for side in Side}
    for joint, name in enumerate(skeleton.names):
        side, rest = split_side(name)
        sides[side].setdefault(normalise_name(rest), joint)
    for rest, joint in sides[Side.LEFT].items():
        partner = sides[Side.RIGHT].get(rest)
        if partner is not None and joint not in found and partner not in found:
            found |= {joint: partner, partner: joint}
    local = kinematics.local_from_world(skeleton.parents, rigmap.rest_quat_xyzw[None])
    origin = torch.zeros(1, 3, dtype=torch.float64)
    positions = kinematics.forward_kinematics(skeleton.offsets, skeleton.parents, origin, local)[0][0]
    positions = positions - positions[joints["hips"]]
    for joint in range(skeleton.num_joints):  # parents come first
        if joint not in found:
            partner = _pair_by_position(joint, found, skeleton, positions)
            found |= {} if partner is None else {joint: partner, partner: joint}
    return [found.get(joint) for joint in range(skeleton.num_joints)]


def _pair_by_position(
    joint: int, found: dict[int, int], skeleton: Skeleton, positions: Float[Tensor, "joints 3"]
) -> int | None:
    parent = skeleton.parents[joint]
    if parent < 0:
        return joint
    # Of a side in the name no partner was found by that name; what has none and is alone in the middle is its own.
    if parent not in found or split_side(skeleton.names[joint])[0] is not Side.MIDDLE:
        return None
    mirrored = positions[joint] * positions.new_tensor([-1.0, 1.0, 1.0])
    free = [other for other in skeleton.children(found[parent]) if other not in found]
    near = min(((float((positions[other] - mirrored).norm()), other) for other in free), default=(_NEAR, joint))
    if near[0] < _NEAR:
        return near[1]
    return joint if found[parent] == parent else None


# A reflection through x = 0 keeps rotation about x and reverses rotation about y and z.
_FLIP = torch.tensor([-1.0, 1.0, 1.0], dtype=torch.float64)
_FLIP_XYZW = torch.tensor([1.0, -1.0, -1.0, 1.0], dtype=torch.float64)
_OFF_METRES = 0.001  # metres by which toes may be off before legs bring them to their positions


def mirror(motion: Motion, rig: Rig | None = None) -> Motion:
    """Exchange left and right through the plane x = 0 of the world, on the motion's own rig and in its layout.

    Bones stay those of the rig. Where toes would be off by more than a millimetre because bones differ from side to
    side, legs bring them to the mirror image of their partners' positions, so that contacts stay. Joints with a side
    but without a partner keep their own rotations. `rig` wins over what would be recognised; RequestError where the
    rig's joints cannot be identified.
    """
    rigged = RiggedMotion.of(motion, rig)
    mirrored = rigged.with_motion(_mirror_joints(rigged))
    toes = rigged.positions("Toes").flip(1) * _FLIP
    ankles = mirrored.positions("Foot") + toes - mirrored.positions("Toes")
    if float((ankles - mirrored.positions("Foot")).abs().max()) > _OFF_METRES:
        mirrored = mirrored.with_motion(place_ankles(mirrored, ankles))
    return mirrored.in_file_world()


def _mirror_joints(rigged: RiggedMotion) -> Motion:
    """Mirror rotations, travelling joints and the hips; joints without a partner keep their own local rotation."""
    motion, partners, rest = rigged.motion, pair_joints(rigged.rigmap), rigged.rigmap.rest_quat_xyzw
    world = motion.joint_rotations()
    index = torch.tensor([joint if partner is None else partner for joint, partner in enumerate(partners)])
    swung = rotations.multiply(world[:, index], rotations.inverse(rest[index]))
    turned = rotations.multiply(swung * _FLIP_XYZW, rest)
    local = kinematics.local_from_world(motion.skeleton.parents, turned)
    alone = [joint for joint, partner in enumerate(partners) if partner is None]
    local[:, alone] = motion.local_quat_xyzw[:, alone]
    flipped = replace(
        motion,
        root_position=motion.root_position * _FLIP,
        local_quat_xyzw=rotations.make_sign_continuous(local),
        moving_offsets=_mirror_offsets(motion, partners, rest),
    )
    missed = motion.joint_positions()[:, rigged.hips] * _FLIP - flipped.joint_positions()[:, rigged.hips]
    return rigged.with_motion(flipped).shift_hips(missed)


def _mirror_offsets(
    motion: Motion, partners: list[int | None], rest: Float[Tensor, "joints 4"]
) -> dict[int, Float[Tensor, "frames 3"]]:
    """Mirror what joints travel within their parents: how far each is from its position at rest, as its partner was."""
    found = {}
    for joint, partner in enumerate(partners):
        source = joint if partner is None else partner
        track = motion.moving_offsets.get(source)
        if track is None:
            continue
        if partner is None:
            found[joint] = track
            continue
        above, other = (rest[motion.skeleton.parents[j]].expand(len(track), 4) for j in (joint, partner))
        away = rotations.rotate(other, track - motion.skeleton.offsets[partner]) * _FLIP
        found[joint] = motion.skeleton.offsets[joint] + rotations.rotate(rotations.inverse(above), away)
    return found
