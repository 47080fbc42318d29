"""Rigid transforms of the ground: a turn about the vertical, then a shift; and shares of one, as of a cycle's travel.

A place on the ground is the complex number z + ix, so that turning by an angle is multiplying by exp(i angle).
"""

import cmath
import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Complex, Float
from torch import Tensor

from mapctl import rotations
from mapctl.motion import Motion

_NO_TURN = 1e-9  # radians under which a transform is a shift alone


@dataclass(frozen=True)
class GroundTransform:
    """A turn about the vertical through the origin, then a shift over the ground."""

    turn: float
    """Turn, radians; positive turns +Z toward +X."""
    shift_xz: tuple[float, float]
    """Shift along x and z, metres."""

    @property
    def distance(self) -> float:
        """Length of the shift, metres."""
        return math.hypot(*self.shift_xz)

    def share(self, shares: Float[Tensor, " frames"]) -> tuple[Float[Tensor, " frames"], Float[Tensor, "frames 2"]]:
        """Return the turns (radians) and shifts (metres) of shares of this transform: 0 is none, 1 all of it.

        All are turns about the same point, or shifts along one line. Share a and then share b are share a + b.
        """
        if abs(self.turn) < _NO_TURN:
            return 0 * shares, shares[:, None] * shares.new_tensor(self.shift_xz)
        # (1 - exp(i s a)) / (1 - exp(i a)) without the loss of digits that small angles would bring.
        size = torch.sin(shares * self.turn / 2) / math.sin(self.turn / 2)
        x, z = self.shift_xz
        place = torch.polar(size.abs(), (shares - 1) * self.turn / 2) * size.sign() * complex(z, x)
        return shares * self.turn, torch.stack([place.imag, place.real], dim=-1)


def move_over_ground(motion: Motion, turns: Float[Tensor, " frames"], shifts_xz: Float[Tensor, "frames 2"]) -> Motion:
    """Turn each frame of a motion with Y up about the vertical through the origin (radians), then shift it (metres)."""
    local = motion.local_quat_xyzw.clone()
    local[:, 0] = rotations.multiply(rotations.about_y(turns), local[:, 0])
    place = rotations.rotate_about_y(motion.root_position, turns) + rotations.lift_ground(shifts_xz)
    return replace(motion, root_position=place, local_quat_xyzw=rotations.make_sign_continuous(local))


def move_by_share(motion: Motion, transform: GroundTransform, shares: Float[Tensor, " frames"]) -> Motion:
    """Move each frame of a motion with Y up by a share of a transform."""
    return move_over_ground(motion, *transform.share(shares))


def repeat_over_ground(motion: Motion, transform: GroundTransform, times: int) -> Motion:
    """Repeat a motion with Y up, each time moved on by the transform; the first one stays."""
    rounds = torch.arange(times, dtype=torch.float64).repeat_interleave(motion.num_frames)
    tiled = replace(
        motion,
        root_position=motion.root_position.repeat(times, 1),
        local_quat_xyzw=motion.local_quat_xyzw.repeat(times, 1, 1),
        moving_offsets={joint: track.repeat(times, 1) for joint, track in motion.moving_offsets.items()},
    )
    return move_by_share(tiled, transform, rounds)


def fit_ground_transform(
    before: Float[Tensor, "*points 3"], after: Float[Tensor, "*points 3"], *, turning: bool = True
) -> GroundTransform:
    """Fit the transform that brings points nearest to others, by least squares; without `turning` a shift alone."""
    start, stop = (_as_places(points).flatten() for points in (before, after))
    product = ((start - start.mean()).conj() * (stop - stop.mean())).sum()
    turn = float(product.angle()) if turning else 0.0
    shift = complex(stop.mean().item()) - cmath.rect(1.0, turn) * complex(start.mean().item())
    return GroundTransform(turn, (shift.imag, shift.real))


def _as_places(points: Float[Tensor, "*points 3"]) -> Complex[Tensor, "*points"]:
    return torch.complex(points[..., 2], points[..., 0])
