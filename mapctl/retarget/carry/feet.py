"""Where feet go: toes over their own rest height as the giver's, standing ones where the giver's stand, in scale."""

from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from mapctl import kinematics, rotations
from mapctl.kinematics import inverse
from mapctl.motion import Motion
from mapctl.numerics.easing import smootherstep
from mapctl.retarget.carry.character import FEET, HIP_JOINTS, SHINS, TOES
from mapctl.retarget.carry.ground import Ground
from mapctl.retarget.carry.hips import MAX_EXTENSION, leg_bone_lengths
from mapctl.retarget.carry.holding import hold_through, low_pass, mean_by_span, soft_clamp
from mapctl.retarget.stance import MAX_TOE_SINK, SIDES, Stance
from mapctl.skeleton import LIMBS, leg_length

_SOFT_MARGIN = 0.004  # of the leg, before the most that it may be, over which it gives in
_HEEL_DEG, _MAX_HEEL_DEG = 10.0, 60.0  # degrees that toes are raised by when a foot is on its heel, and at most
# Heights over the ground, of the leg: from the first on rotations count, from the second on they alone do.
_LOW_SHARE, _HIGH_SHARE = 0.1, 0.35
_FREE_SECONDS = 0.25  # seconds over which the shift of feet that never stand is smoothed


def find_ankle_targets(
    own: Motion, moved: Motion, giver: Stance, body: Stance, ground: Ground, *, scale: float, raised: Tensor
) -> Float[Tensor, "frames 2 3"]:
    """Return target ankle positions, metres: toe joints as the giver's in scale, over their own rest heights, and moved
    over the ground to where the body's rotations bring them, by as much throughout a contact. High over what they
    stand on rotations alone count: a kick is a pose, not a position. `raised` (frames, 2) is by how much that ground
    is kept higher than in scale, metres."""
    toes, places = own.joint_positions()[:, TOES], scale * own.joint_positions()[:, FEET]
    shift = moved.joint_positions()[:, TOES] - scale * toes
    for k, spans in enumerate(ground.spans):
        aside = shift[:, k, ::2]
        free = low_pass(aside, _FREE_SECONDS * float(own.fps)) if not spans else None
        places[:, k, ::2] += hold_through(spans, mean_by_span(aside, spans), len(toes)) if free is None else free
    over = scale * (toes[..., 1] - giver.floor - giver.flat_height)
    lifted = torch.where(over < 0, MAX_TOE_SINK * torch.expm1(over / MAX_TOE_SINK) - over, 0.0)
    places[..., 1] += (1 - scale) * giver.floor + body.standing_height - scale * giver.flat_height + lifted + raised
    share = (over - scale * ground.height) / leg_length(moved.skeleton)
    high = smootherstep((share - _LOW_SHARE) / _HIGH_SHARE)[..., None]
    return torch.lerp(places + _foot_length_offset(own, moved, scale), moved.joint_positions()[:, FEET], high)


def _foot_length_offset(own: Motion, moved: Motion, scale: float) -> Float[Tensor, "frames 2 3"]:
    """Return the offset of the ankle from where it would be if the foot were the giver's in scale, metres.

    A foot whose heel is raised pivots on its toes, one whose toes are raised on its heel, right below the ankle: then
    the ankle follows the giver's trajectory, as if the foot were flat.
    """
    longer = (scale * own.skeleton.offsets - moved.skeleton.offsets)[TOES].expand(own.num_frames, 2, 3)
    turns = own.joint_rotations()[:, FEET]
    heading, tilt = rotations.split_heading(turns)
    forward = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64).expand_as(longer)
    rises = (rotations.rotate(turns, axis)[..., 1] for axis in (forward, forward.roll(-1, -1)))
    up = torch.rad2deg(torch.atan2(*rises))
    on_toes = 1 - smootherstep(up / _HEEL_DEG) * (1 - smootherstep((up - _MAX_HEEL_DEG) / _MAX_HEEL_DEG))
    still = torch.tensor([0.0, 0.0, 0.0, 1.0], dtype=torch.float64).expand_as(tilt)
    tilt = rotations.slerp(still, tilt, on_toes)
    return rotations.rotate(rotations.multiply(rotations.about_y(heading), tilt), longer)


def reach_ankle_targets(moved: Motion, ankles: Float[Tensor, "frames 2 3"]) -> Motion:
    """Bend and rotate legs so that ankles reach their targets; feet keep their orientation in the world."""
    places, world = moved.joint_positions().clone(), moved.joint_rotations()
    at, most = places[:, HIP_JOINTS], MAX_EXTENSION * leg_bone_lengths(moved.skeleton)
    to_ankles = ankles - at
    far = to_ankles.norm(dim=-1)
    places[:, FEET] = at + to_ankles * (soft_clamp(far, most, _SOFT_MARGIN) / far.clamp_min(1e-9))[..., None]
    free = torch.zeros(places.shape[:2], dtype=torch.bool)
    free[:, [*HIP_JOINTS, *SHINS]] = True
    legs = [LIMBS[side + "Foot"] for side in SIDES]
    local = inverse.solve_inverse_kinematics(
        places, moved.local_quat_xyzw, moved.skeleton, free=free, root_position=moved.root_position, limbs=legs
    )
    turned = replace(moved, local_quat_xyzw=local).joint_rotations().clone()
    turned[:, [*FEET, *TOES]] = world[:, [*FEET, *TOES]]
    local = rotations.make_sign_continuous(kinematics.local_from_world(moved.skeleton.parents, turned))
    return replace(moved, local_quat_xyzw=local)
