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


def skate(toes: ToeMeasurements, reach: float = SKATE_REACH) -> float:
    """Return the mean over frames and toes of speed (2 - 2^(h / reach)) where the height h is under `reach`; m/s."""
    height = toes.height[1:]
    weight = torch.where(height < reach, 2 - torch.exp2(height.clamp(0, reach) / reach), 0.0)
    return float((toes.speed * weight).mean())


def skate_ratio(toes: ToeMeasurements, *, height: float = 0.05, speed: float = 0.2) -> float:
    """Return the share of toe-frames under `height` metres, at both ends of the step, that move faster than `speed`."""
    low = toes.height < height
    return float((low[1:] & low[:-1] & (toes.speed > speed)).double().mean())


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
