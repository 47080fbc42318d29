"""Foot measures: skate, contact speed, planted share, penetration and float.

The floor is the clip's own: the 5th percentile of each toe's height.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mapctl import contacts

SKATE_REACH = 0.025
"""Height over the floor below which a moving toe skates, metres."""


@dataclass(frozen=True, eq=False)
class ToeMeasurements:
    """Toe joints of a clip with what every foot measure starts from; one row for each frame but the first."""

    height: Float[Tensor, "frames feet"]
    """Over the floor, metres, all frames."""
    speed: Float[Tensor, "steps feet"]
    """Over the ground on the way to each frame but the first, m/s."""
    planted: Bool[Tensor, "frames feet"]
    """By `contacts.planted`, all frames."""

    @staticmethod
    def of(toe_positions: Float[Tensor, "frames feet 3"], fps: float) -> "ToeMeasurements":
        """From positions in metres."""
        height = toe_positions[..., 1] - contacts.estimate_floor_heights(toe_positions)
        speed = toe_positions[..., ::2].diff(dim=0).norm(dim=-1) * fps
        return ToeMeasurements(height, speed, contacts.detect_contacts(toe_positions, fps))


def skate(toes: ToeMeasurements, reach: float = SKATE_REACH) -> float:
    """Mean over frames and toes of speed (2 - 2^(h / reach)) where the height h is under `reach`; m/s."""
    height = toes.height[1:]
    weight = torch.where(height < reach, 2 - torch.exp2(height.clamp(0, reach) / reach), 0.0)
    return float((toes.speed * weight).mean())


def skate_ratio(toes: ToeMeasurements, *, height: float = 0.05, speed: float = 0.2) -> float:
    """Share of toe-frames under `height` metres, at both ends of the step, that move faster than `speed`."""
    low = toes.height < height
    return float((low[1:] & low[:-1] & (toes.speed > speed)).double().mean())


def contact_speed(toes: ToeMeasurements) -> float:
    """Mean speed of planted toes over the ground, m/s; NaN if none is ever planted."""
    return float(toes.speed[toes.planted[1:]].mean())


def planted_share(toes: ToeMeasurements) -> float:
    """Share of toe-frames that are planted."""
    return float(toes.planted[1:].double().mean())


def penetration(toes: ToeMeasurements) -> float:
    """Mean depth of planted toes under the floor, metres; NaN if none is ever planted."""
    return float((-toes.height[toes.planted]).clamp_min(0).mean())


def float_height(toes: ToeMeasurements) -> float:
    """Mean height of planted toes over the floor, metres; NaN if none is ever planted."""
    return float(toes.height[toes.planted].clamp_min(0).mean())
