"""Easing from one value to another."""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from numpy.polynomial.polynomial import polyder, polyval
from torch import Tensor


def smootherstep(share: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
    """Ease from 0 to 1 over 0 to 1, with two continuous derivatives (Perlin 2002); held beyond."""
    share = share.clamp(0, 1)
    return share**3 * (10 + share * (6 * share - 15))


@dataclass(frozen=True, eq=False)
class MinimumJerkTrack:
    """A point moving to a goal, with no jump in place, velocity or acceleration when the goal changes."""

    value: Float[Tensor, " size"]
    """Where it is."""
    velocity: Float[Tensor, " size"]
    """Its velocity, units a second."""
    acceleration: Float[Tensor, " size"]
    """Its acceleration, units a second squared."""
    goal: Float[Tensor, " size"]
    """Where it is to come to rest."""
    left: float = 0.0
    """Seconds until it does."""

    @staticmethod
    def rest_at(value: Float[Tensor, " size"]) -> "MinimumJerkTrack":
        return MinimumJerkTrack(value, torch.zeros_like(value), torch.zeros_like(value), value)

    @property
    def resting(self) -> bool:
        """Whether it has come to its goal."""
        return self.left <= 0.0

    def aim(self, goal: Float[Tensor, " size"], seconds: float) -> "MinimumJerkTrack":
        """Come to rest at a goal in so many seconds; one that it has already changes nothing."""
        return self if torch.equal(goal, self.goal) else replace(self, goal=goal, left=seconds)

    def move(self, seconds: float) -> "MinimumJerkTrack":
        """Move on for so many seconds, along the polynomial of fifth degree that ends at rest in the goal."""
        if self.left <= seconds:
            return MinimumJerkTrack.rest_at(self.goal)
        left, away = self.left, self.goal - self.value
        speed, bend = self.velocity * left, self.acceleration * left**2
        third = 10 * away - 6 * speed - 1.5 * bend
        fourth = -15 * away + 8 * speed + 1.5 * bend
        fifth = 6 * away - 3 * speed - 0.5 * bend
        coefficients = torch.stack([self.value, speed, 0.5 * bend, third, fourth, fifth]).numpy()
        value, velocity, acceleration = (
            torch.as_tensor(polyval(seconds / left, polyder(coefficients, order)) / left**order) for order in range(3)
        )
        return MinimumJerkTrack(value, velocity, acceleration, self.goal, left - seconds)
