"""What was wrong with a recording, as a list that a person can read."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mapctl.numerics.intervals import runs

NOISE_DEG, NOISE_CM = 0.5, 0.2
"""Noise below this is not worth a line: optical capture has as much."""
_SLIDE = 0.2  # m/s that a planted toe moves by, over some frames, before it is said to slide
_FLOAT = 0.03  # metres that it is above its rest height
_SHORTEST = 3  # frames of either


@dataclass(frozen=True)
class Fault:
    """One thing that was wrong."""

    joint: str
    """Of the recording's rig."""
    start: int
    """First frame, from 0."""
    stop: int
    """One past the last."""
    kind: str
    """noise, spike, dropout, slide or float."""
    amount: float
    """How much: the noise's sigma, the height of a spike or of a floating toe, the way of a slide; 0 of a dropout."""
    unit: str
    """Of the amount."""


def noise(
    names: Sequence[str], angles: Float[Tensor, " joints"], root: float, *, travels: int, frames: int
) -> list[Fault]:
    """Joints whose angles shake (radians), and the place of the joint that travels (metres)."""
    degrees = torch.rad2deg(angles).tolist()
    found = [
        Fault(name, 0, frames, "noise", amount, "deg")
        for name, amount in zip(names, degrees, strict=True)
        if amount >= NOISE_DEG
    ]
    if 100 * root >= NOISE_CM:
        found.append(Fault(names[travels], 0, frames, "noise", 100 * root, "cm"))
    return found


def leaping(
    names: Sequence[str], spikes: Bool[Tensor, "frames joints"], away: Float[Tensor, "frames joints"], unit: str
) -> list[Fault]:
    """Spikes, and how far each lies from what replaced it."""
    return [
        Fault(names[joint], start, stop, "spike", float(away[start:stop, joint].max()), unit)
        for joint, start, stop in runs(spikes)
    ]


def lost(names: Sequence[str], dropouts: Bool[Tensor, "frames joints"]) -> list[Fault]:
    """Where joints were not seen."""
    return [Fault(names[joint], start, stop, "dropout", 0.0, "") for joint, start, stop in runs(dropouts)]


def feet(
    names: Sequence[str],
    toes: Float[Tensor, "frames 2 3"],
    planted: Bool[Tensor, "frames 2"],
    *,
    rest_height: float,
    fps: float,
) -> list[Fault]:
    """Planted toes that slide, and planted toes in the air; world positions, metres, at any rate."""
    steps = torch.diff(toes[..., ::2], dim=0, prepend=toes[:1, :, ::2]).norm(dim=-1)
    slides = planted & (steps * fps > _SLIDE)
    floats = planted & (toes[..., 1] > rest_height + _FLOAT)
    found = [
        Fault(names[foot], start, stop, "slide", 100 * float(steps[start:stop, foot].sum()), "cm")
        for foot, start, stop in runs(slides)
        if stop - start >= _SHORTEST
    ]
    height = 100 * (toes[..., 1] - rest_height)
    return found + [
        Fault(names[foot], start, stop, "float", float(height[start:stop, foot].max()), "cm")
        for foot, start, stop in runs(floats)
        if stop - start >= _SHORTEST
    ]
