"""Left and right exchanged, on any rig, through the plane x = 0 of the world (with Y up).

A joint's rotation in the world, as told from its own in the T-pose, becomes the mirror image of its partner's:
W' = M W_p R_p^-1 M R, with M the mirror through x = 0 and R the rotations in the T-pose. So the rig keeps its bones,
fingers and twists turn as their partners did, and mirroring twice gives W again.
"""

from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from mapctl import kinematics, rotations
from mapctl.editing.joint_pairs import pair_joints
from mapctl.editing.legs import place_ankles
from mapctl.editing.rigged_motion import RiggedMotion
from mapctl.motion import Motion
from mapctl.retarget.rigs import Rig

# A reflection through x = 0 keeps rotation about x and reverses rotation about y and z.
_FLIP = torch.tensor([-1.0, 1.0, 1.0], dtype=torch.float64)
_FLIP_XYZW = torch.tensor([1.0, -1.0, -1.0, 1.0], dtype=torch.float64)
_OFF_METRES = 0.001  # metres by which toes may be off before legs bring them to their places


def mirror(motion: Motion, rig: Rig | None = None) -> Motion:
    """Exchange left and right through the plane x = 0 of the world, on the motion's own rig and in its layout.

    Bones stay those of the rig. Where toes would be off by more than a millimetre because bones differ from side to
    side, legs bring them to the mirror image of their partners' places, so that contacts stay. Joints with a side but
    without a partner keep their own rotations. `rig` wins over what would be recognised; RequestError where the rig's
    joints cannot be identified.
    """
    rigged = RiggedMotion.of(motion, rig)
    mirrored = rigged.with_motion(_mirror_joints(rigged))
    ankles = _find_ankle_targets(rigged, mirrored)
    if float((ankles - mirrored.positions("Foot")).abs().max()) > _OFF_METRES:
        mirrored = mirrored.with_motion(place_ankles(mirrored, ankles))
    return mirrored.in_file_world()


def _mirror_joints(rigged: RiggedMotion) -> Motion:
    """Mirror all rotations, travelling joints and the place of the hips. Joints without a partner keep their own local
    rotation."""
    motion, partners, rest = rigged.motion, pair_joints(rigged.rigmap), rigged.rigmap.rest_quat_xyzw
    turned = _mirror_rotations(motion.joint_rotations(), partners, rest)
    local = kinematics.local_from_world(motion.skeleton.parents, turned)
    alone = [joint for joint, partner in enumerate(partners) if partner is None]
    local[:, alone] = motion.local_quat_xyzw[:, alone]
    made = replace(
        motion,
        root_position=motion.root_position * _FLIP,
        local_quat_xyzw=rotations.make_sign_continuous(local),
        moving_offsets=_mirror_offsets(motion, partners, rest),
    )
    mirrored, hips = rigged.with_motion(made), rigged.hips
    missed = motion.joint_positions()[:, hips] * _FLIP - made.joint_positions()[:, hips]
    return mirrored.shift_hips(missed)


def _mirror_rotations(
    world: Float[Tensor, "frames joints 4"], partners: list[int | None], rest: Float[Tensor, "joints 4"]
) -> Float[Tensor, "frames joints 4"]:
    """Return the mirror image of world rotations; joints without a partner are left as they are."""
    index = torch.tensor([joint if partner is None else partner for joint, partner in enumerate(partners)])
    swung = rotations.multiply(world[:, index], rotations.inverse(rest[index]).expand(world.shape))
    return rotations.multiply(swung * _FLIP_XYZW, rest.expand(world.shape))


def _mirror_offsets(
    motion: Motion, partners: list[int | None], rest: Float[Tensor, "joints 4"]
) -> dict[int, Float[Tensor, "frames 3"]]:
    """Mirror what joints travel within their parents: how far each is from its place at rest, as its partner was."""
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


def _find_ankle_targets(rigged: RiggedMotion, mirrored: RiggedMotion) -> Float[Tensor, "frames 2 3"]:
    """Return where ankles go, metres, so that toes are where their partners were, mirrored."""
    toes = rigged.positions("Toes").flip(1) * _FLIP
    return mirrored.positions("Foot") + toes - mirrored.positions("Toes")
