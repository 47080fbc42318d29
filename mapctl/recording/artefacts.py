"""Artefacts of a recording, as a list that a person can read."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mapctl.numerics.intervals import true_intervals

NOISE_DEG, NOISE_CM = 0.5, 0.2
"""Least noise that is listed, degrees and centimetres: optical capture has as much."""
_SKATE_SPEED = 0.2  # m/s that a planted toe moves by, over some frames, before it is said to slide
_FLOAT_HEIGHT = 0.03  # metres that it is above its support
_MIN_FRAMES = 3  # frames of either


@dataclass(frozen=True)
class Artefact:
    """One artefact of a recording."""

    joint: str
    """Name of the joint on the recording's rig."""
    start: int
    """First frame, from 0."""
    stop: int
    """One past the last frame."""
    kind: str
    """noise, spike, dropout, frozen, slide, float, swap: left and right limb exchanged, or stretch: an offset of a bone
    that varies only by noise."""
    amount: float
    """Noise's sigma, height of a spike or of a floating toe, distance of a slide, largest error of an offset, largest
    turn of a swap; 0 for a dropout and frozen frames."""
    unit: str
    """Unit of the amount."""


def list_noise(
    names: Sequence[str], angles: Float[Tensor, " joints"], root: float, *, travels: int, frames: int
) -> list[Artefact]:
    """List joints whose angles are noisy (radians), and the position of the travelling joint (metres)."""
    degrees = torch.rad2deg(angles).tolist()
    found = [
        Artefact(name, 0, frames, "noise", amount, "deg")
        for name, amount in zip(names, degrees, strict=True)
        if amount >= NOISE_DEG
    ]
    if 100 * root >= NOISE_CM:
        found.append(Artefact(names[travels], 0, frames, "noise", 100 * root, "cm"))
    return found


def list_spikes(
    names: Sequence[str], spikes: Bool[Tensor, "frames joints"], away: Float[Tensor, "frames joints"], unit: str
) -> list[Artefact]:
    """List spikes, and how far each is from what replaced it."""
    return [
        Artefact(names[joint], start, stop, "spike", float(away[start:stop, joint].max()), unit)
        for joint, start, stop in true_intervals(spikes)
    ]


def list_dropouts(names: Sequence[str], dropouts: Bool[Tensor, "frames joints"]) -> list[Artefact]:
    """List where joints were not observed."""
    return [Artefact(names[joint], start, stop, "dropout", 0.0, "") for joint, start, stop in true_intervals(dropouts)]


def list_foot_artefacts(
    names: Sequence[str],
    toes: Float[Tensor, "frames 2 3"],
    planted: Bool[Tensor, "frames 2"],
    *,
    rest_height: Float[Tensor, "frames 2"],
    fps: float,
) -> list[Artefact]:
    """List planted toes that slide, and planted toes over the height that they rest at; world positions, metres, at any
    rate."""
    steps = torch.diff(toes[..., ::2], dim=0, prepend=toes[:1, :, ::2]).norm(dim=-1)
    slides = planted & (steps * fps > _SKATE_SPEED)
    height = toes[..., 1] - rest_height
    floats = planted & (height > _FLOAT_HEIGHT)
    found = [
        Artefact(names[foot], start, stop, "slide", 100 * float(steps[start:stop, foot].sum()), "cm")
        for foot, start, stop in true_intervals(slides)
        if stop - start >= _MIN_FRAMES
    ]
    return found + [
        Artefact(names[foot], start, stop, "float", 100 * float(height[start:stop, foot].max()), "cm")
        for foot, start, stop in true_intervals(floats)
        if stop - start >= _MIN_FRAMES
    ]
