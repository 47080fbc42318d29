"""Where hips and feet go on the receiving body: the giver's trajectories in scale, as legs and ground ask for.

What the giver's feet stand on is the floor, or what is higher, as stairs and platforms. Toes are as far over their own
rest height as the giver's, standing ones where the giver's stand.
"""

import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mapctl import contacts, kinematics, rotations
from mapctl.kinematics import inverse
from mapctl.motion import Motion
from mapctl.numerics.easing import smootherstep
from mapctl.retarget.carry.character import LEGS, RiggedCharacter, limb_lengths
from mapctl.retarget.carry.holding import (
    Spans,
    envelope,
    hold_through,
    low_pass,
    mean_by_span,
    merge_contacts,
    soft_clamp,
)
from mapctl.retarget.stance import FEET, HIP_JOINTS, MAX_TOE_SINK, SHINS, TOES, Stance
from mapctl.skeleton import Skeleton, leg_length

_FREE_EXTENSION = 0.985  # of the leg: a leg may be that straight, whatever the giver's is
_MAX_EXTENSION = 0.9995  # of the leg: how straight one may be at most
_HIP_FIT_SECONDS = 0.06  # seconds over which the height of hips is smoothed
_HIP_DROP_SECONDS = 0.12  # seconds over which hips go down for a leg that is too short, and up again
_SMOOTH_SECONDS = 0.05  # seconds over which what hips carry is smoothed
# Of the leg's length, from where on a leg is so straight that the hips' height begins to matter to it, and does fully.
_STRAIGHT_SHARES = (0.93, 0.985)
# Of the leg's length, how far down a foot is from which the hips' height begins to matter to it, and matters fully.
_DOWN_SHARES = (0.5, 0.8)
_LEAST_SAY = 0.02  # of both legs together, below which the hips' height is left to the trajectory
_UP = torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64)
_SOFT_MARGIN = 0.004  # of the leg, before the most that it may be, over which it gives in
_HEEL_DEG, _MAX_HEEL_DEG = 10.0, 60.0  # degrees that toes are raised by when a foot is on its heel, and at most
# Heights over the ground, of the leg: from the first on rotations count, from the second on they alone do.
_LOW_SHARE, _HIGH_SHARE = 0.1, 0.35
_FREE_SECONDS = 0.25  # seconds over which the shift of feet that never stand is smoothed
# Who stands higher than the floor stands still on a level foot for a while, with the hips well over it.
_RAISED_METRES = 0.05  # metres over the floor from which the ground is no floor
_STILL_SPEED, _STILL_SECONDS = 0.3, 0.2  # m/s in space below which a toe is still, and for how long
_SPEED_SECONDS = 0.1  # seconds over which that speed is the mean, or a capture's noise looks like motion
_LEVEL_DEG = 20.0  # degrees that a level foot is off
_HIPS_SHARE = 0.5  # of the leg, that hips are over a foot that bears them
_BODY_SECONDS = 0.2  # seconds over which the ground under the hips is smoothed


@dataclass(frozen=True, eq=False)
class Ground:
    """Where a giver's feet stand; in the order left, right."""

    spans: tuple[Spans, ...]
    """Contacts by foot: first frame and one past the last."""
    height: Float[Tensor, "frames 2"]
    """Height of what each foot stands on over the clip's floor, metres; on the way from one contact to the next
    smoothly between theirs."""

    def under_hips(self, fps: float) -> Float[Tensor, " frames"]:
        """Return the height of the ground under the body over the clip's floor, metres: the mean of both feet's."""
        return low_pass(self.height.mean(dim=1, keepdim=True), _BODY_SECONDS * fps)[:, 0]


def find_ground(own: Motion, stance: Stance) -> Ground:
    """Find what the feet of a clip stand on (canonical joints, feet level in the T-pose)."""
    toes, frames = own.joint_positions()[:, TOES], own.num_frames
    over = toes[..., 1] - stance.floor - stance.flat_height
    bearing = _detect_bearing(own)
    spans, heights = merge_contacts(contacts.detect_contacts(toes, own.fps) | bearing, toes, float(own.fps)), []
    for k, of_foot in enumerate(spans):
        height = torch.zeros(frames, 1, dtype=torch.float64)
        if of_foot:
            means, bears = (mean_by_span(v[:, k, None], of_foot) for v in (over, bearing.double()))
            height = hold_through(of_foot, torch.where((bears > 0.5) & (means > _RAISED_METRES), means, 0.0), frames)
        heights.append(height)
    return Ground(tuple(spans), torch.cat(heights, dim=1))


def _detect_bearing(own: Motion) -> Bool[Tensor, "frames 2"]:
    """Detect feet that bear the body, at any height: higher than the floor, or on a floor that drifts with the take."""
    places, fps = own.joint_positions(), float(own.fps)
    step = max(1, round(_SPEED_SECONDS * fps))
    if own.num_frames <= step:
        return torch.zeros(own.num_frames, 2, dtype=torch.bool)
    speed = (places[step:, TOES] - places[:-step, TOES]).norm(dim=-1) * (fps / step)
    before = step // 2  # a frame's speed is that of the time around it
    speed = torch.cat([speed[:1].expand(before, 2), speed, speed[-1:].expand(step - before, 2)])
    forward = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64).expand(own.num_frames, 2, 3)
    slope = rotations.rotate(own.joint_rotations()[:, FEET], forward)[..., 1].abs()
    bears = places[:, HIP_JOINTS, 1] - places[:, TOES, 1] > _HIPS_SHARE * leg_length(own.skeleton)
    level = slope < math.sin(math.radians(_LEVEL_DEG))
    still = (speed < _STILL_SPEED) & level & bears
    return contacts.remove_short_runs(still, max(1, round(_STILL_SECONDS * fps)))


def transfer_root(
    own: Motion, giver: RiggedCharacter, body: RiggedCharacter, scale: float, raised: Float[Tensor, " frames"]
) -> Motion:
    """Put the giver's rotations on the body's bones. The middle between the thighs follows its trajectory in scale, as
    much higher as ankles, floor and `raised` (metres, by what the ground is kept higher than in scale) ask for."""
    to_thighs = body.leveled.offsets[HIP_JOINTS].mean(0) - scale * own.skeleton.offsets[HIP_JOINTS].mean(0)
    turns = own.joint_rotations()[:, 0]
    # The hips' rotation is noisy; what they carry at another distance is not to shake for it.
    aside = low_pass(rotations.rotate(turns, to_thighs.expand(own.num_frames, 3)), _SMOOTH_SECONDS * float(own.fps))
    ankle = _ankle_height(body.stance.standing_height, body.leveled)
    others = _ankle_height(giver.stance.flat_height, own.skeleton)
    rise = _UP * (ankle - scale * others + (1 - scale) * giver.stance.floor + raised)[:, None]
    return replace(own, skeleton=body.leveled, root_position=scale * own.root_position + rise - aside, source=None)


def _ankle_height(toe_height: Float[Tensor, "2"], leveled: Skeleton) -> Float[Tensor, ""]:
    """Return the height of the ankles over the floor while feet lie flat, metres, mean of both."""
    return (toe_height - leveled.offsets[TOES, 1]).mean()


def fit_hips(moved: Motion, ankles: Float[Tensor, "frames 2 3"], stretch: Float[Tensor, "frames 2"]) -> Motion:
    """Raise or lower hips smoothly until legs that reach the ankles' targets are as straight as the giver's.

    This has an inverse, so that a clip that goes to another body and back has its hips where they were.
    """
    short, down = _find_missing_length(moved, ankles, stretch.clamp(max=_MAX_EXTENSION))
    begin, end = _DOWN_SHARES
    bent, straight = _STRAIGHT_SHARES
    say = smootherstep((stretch - bent) / (straight - bent)) * smootherstep((down - begin) / (end - begin))
    total = say.sum(dim=-1, keepdim=True)
    lower = (say * short).sum(dim=-1, keepdim=True) / (total + _LEAST_SAY)
    return _lower(moved, low_pass(lower, _HIP_FIT_SECONDS * float(moved.fps)))


def lower_hips(moved: Motion, ankles: Float[Tensor, "frames 2 3"], stretch: Float[Tensor, "frames 2"]) -> Motion:
    """Lower hips smoothly until legs reach the ankles' targets no straighter than the giver's, or than most."""
    short, down = _find_missing_length(moved, ankles, stretch.clamp(_FREE_EXTENSION, _MAX_EXTENSION))
    # A leg that points sideways or up is not helped by lower hips.
    short = torch.where(down > _DOWN_SHARES[0], short.clamp_min(0), 0.0).amax(dim=-1, keepdim=True)
    return _lower(moved, envelope(short, _HIP_DROP_SECONDS, float(moved.fps)))


def _find_missing_length(
    moved: Motion, ankles: Float[Tensor, "frames 2 3"], extension: Float[Tensor, "frames 2"]
) -> tuple[Float[Tensor, "frames 2"], Float[Tensor, "frames 2"]]:
    """Return by how much the hips are too high for a leg of this extension to reach its ankle's target, metres, and how
    far down that is, of this leg's length."""
    to_ankles = ankles - moved.joint_positions()[:, HIP_JOINTS]
    most = limb_lengths(moved.skeleton, LEGS) * extension
    level, down = to_ankles[..., ::2].square().sum(-1), -to_ankles[..., 1]
    return down - (most.square() - level).clamp_min(0).sqrt(), down / most


def _lower(moved: Motion, dip: Float[Tensor, "frames 1"]) -> Motion:
    return replace(moved, root_position=moved.root_position - dip * _UP)


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
    at, most = places[:, HIP_JOINTS], _MAX_EXTENSION * limb_lengths(moved.skeleton, LEGS)
    to_ankles = ankles - at
    far = to_ankles.norm(dim=-1)
    places[:, FEET] = at + to_ankles * (soft_clamp(far, most, _SOFT_MARGIN) / far.clamp_min(1e-9))[..., None]
    free = torch.zeros(places.shape[:2], dtype=torch.bool)
    free[:, [*HIP_JOINTS, *SHINS]] = True
    local = inverse.solve_inverse_kinematics(
        places, moved.local_quat_xyzw, moved.skeleton, free=free, root_position=moved.root_position, limbs=LEGS
    )
    turned = replace(moved, local_quat_xyzw=local).joint_rotations().clone()
    turned[:, [*FEET, *TOES]] = world[:, [*FEET, *TOES]]
    local = rotations.make_sign_continuous(kinematics.local_from_world(moved.skeleton.parents, turned))
    return replace(moved, local_quat_xyzw=local)
