"""What the giver's feet stand on: contacts with the floor and with what is higher, as stairs and platforms."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mapctl import contacts, rotations
from mapctl.motion import Motion
from mapctl.retarget.carry.holding import Spans, hold_through, low_pass, mean_by_span, merge_contacts
from mapctl.retarget.stance import FEET, HIP_JOINTS, TOES, Stance
from mapctl.skeleton import leg_length

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
