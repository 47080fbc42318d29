"""Foot measures: skate, contact speed, planted share, penetration and float of toes; speed and slide of heels.

The floor is the clip's own: the 5th percentile of each toe's height.
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mapctl import contacts, rotations
from mapctl.contacts import derive_heel_contacts
from mapctl.motion import Motion
from mapctl.numerics.intervals import true_intervals
from mapctl.retarget.character import level_feet
from mapctl.skeleton import FEET, TOES, find_heel_drops, find_heels

SKATE_REACH = 0.025
"""Height over the floor below which a moving toe skates, metres."""


@dataclass(frozen=True, eq=False)
class ToeMeasurements:
    """Toe joints of a clip with the inputs of every foot measure."""

    height: Float[Tensor, "frames feet"]
    """Height over the floor, metres, all frames."""
    speed: Float[Tensor, "steps feet"]
    """Speed over the ground from the frame before, m/s, all frames but the first."""
    planted: Bool[Tensor, "frames feet"]
    """Contacts by `contacts.detect_contacts`, all frames."""

    @staticmethod
    def of(toe_positions: Float[Tensor, "frames feet 3"], fps: float) -> "ToeMeasurements":
        """Measure toe positions in metres."""
        height = toe_positions[..., 1] - contacts.estimate_floor_heights(toe_positions)
        speed = toe_positions[..., ::2].diff(dim=0).norm(dim=-1) * fps
        return ToeMeasurements(height, speed, contacts.detect_contacts(toe_positions, fps))


def skate(toes: ToeMeasurements) -> float:
    """Return the mean over frames and toes of speed (2 - 2^(h / 2.5 cm)) where the height h is under 2.5 cm; m/s."""
    height = toes.height[1:]
    weight = torch.where(height < SKATE_REACH, 2 - torch.exp2(height.clamp(0, SKATE_REACH) / SKATE_REACH), 0.0)
    return float((toes.speed * weight).mean())


def skate_ratio(toes: ToeMeasurements) -> float:
    """Return the share of toe-frames under 5 cm, at both ends of the step, that move faster than 0.2 m/s."""
    low = toes.height < 0.05
    return float((low[1:] & low[:-1] & (toes.speed > 0.2)).double().mean())


def contact_speed(toes: ToeMeasurements) -> float:
    """Return the mean speed of planted toes over the ground, m/s; NaN if none is ever planted."""
    return float(toes.speed[toes.planted[1:]].mean())


def planted_share(toes: ToeMeasurements) -> float:
    """Return the share of toe-frames that are planted."""
    return float(toes.planted[1:].double().mean())


def penetration(toes: ToeMeasurements) -> float:
    """Return the mean depth of planted toes under the floor, metres; NaN if none is ever planted."""
    return float((-toes.height[toes.planted]).clamp_min(0).mean())


def float_height(toes: ToeMeasurements) -> float:
    """Return the mean height of planted toes over the floor, metres; NaN if none is ever planted."""
    return float(toes.height[toes.planted].clamp_min(0).mean())


def locate_heels(motion: Motion) -> Float[Tensor, "frames 2 3"]:
    """Locate the left and the right heel of a motion of canonical joints whose foot frames are aligned with the world
    while feet are flat: world positions, metres (see `skeleton.find_heels`)."""
    feet, offsets = motion.skeleton.indices(FEET), find_heels(motion.skeleton)
    turned = rotations.rotate(motion.joint_rotations()[:, feet], offsets)
    return motion.joint_positions()[:, feet] + turned


def measure_heels(motion: Motion) -> dict[str, float]:
    """Measure the heels of a motion of canonical joints; how its feet lie flat is shown by the clip.

    `heel_contact_speed_cm_s`: mean speed of planted heels over the ground; `heel_planted_share`; `heel_slide_max_cm`:
    how far a heel gets at most from where it was planted, within one contact; `foot_turn_deg_s`: mean rate at which
    feet turn about the vertical while toe and heel are planted. NaN where none is planted.
    """
    level, fps = level_feet(motion), float(motion.fps)
    toes, heels = level.joint_positions()[:, level.skeleton.indices(TOES)], locate_heels(level)
    drops = heels.new_tensor(find_heel_drops(level.skeleton))
    planted = derive_heel_contacts(contacts.detect_contacts(toes, fps), toes, heels, drops, fps)
    stays, forward, ground = planted[1:] & planted[:-1], toes - heels, heels[..., ::2]
    yaw = rotations.unwrap_angle(torch.atan2(forward[..., 0], forward[..., 2]).T).T
    runs = [ground[start:stop, foot] for foot, start, stop in true_intervals(planted)]
    slides = [float((run - run[0]).norm(dim=-1).max()) for run in runs]
    return {
        "heel_contact_speed_cm_s": 100 * float((ground.diff(dim=0).norm(dim=-1) * fps)[stays].mean()),
        "heel_planted_share": float(planted[1:].double().mean()),
        "heel_slide_max_cm": 100 * max(slides, default=math.nan),
        "foot_turn_deg_s": math.degrees(float((yaw.diff(dim=0).abs() * fps)[stays].mean())),
    }
