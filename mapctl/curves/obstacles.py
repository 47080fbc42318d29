"""Obstacles on the ground: discs and boxes to keep clear of."""

import math
from dataclasses import dataclass
from typing import ClassVar

import torch
from jaxtyping import Float
from torch import Tensor

from mapctl.arguments import read_number, read_point
from mapctl.errors import RequestError


@dataclass(frozen=True)
class Obstacle:
    """A disc of some radius, or a box of some size; as high as one likes."""

    __pydantic_config__: ClassVar = {"extra": "forbid", "allow_inf_nan": False}

    place: tuple[float, float]
    """Its centre on the ground, x and z, metres."""
    radius: float | None = None
    """Radius of a disc, metres; or `size`."""
    size: tuple[float, float] | None = None
    """Width (along x) and depth (along z) of a box before it is turned, metres."""
    turn_deg: float = 0.0
    """Turn of a box about its centre, degrees; positive turns +Z toward +X."""

    def __post_init__(self):
        object.__setattr__(self, "place", read_point(self.place, 2, "the position of an obstacle"))
        where = f"an obstacle at {self.place[0]:g}, {self.place[1]:g}"
        if (self.radius is None) == (self.size is None):
            raise RequestError(f"{where} has a radius or a size, one of them")
        if self.size is None:
            lengths = (read_number(self.radius, "the radius of an obstacle"),)
            object.__setattr__(self, "radius", lengths[0])
        else:
            lengths = read_point(self.size, 2, "the size of an obstacle")
            object.__setattr__(self, "size", lengths)
        if min(lengths) <= 0:
            raise RequestError(f"lengths of {where} must be positive, got {lengths}")

    @staticmethod
    def parse(text: str) -> "Obstacle":
        """Parse the disc `X,Z,RADIUS`, metres; RequestError for anything else."""
        try:
            x, z, radius = (float(word) for word in text.split(","))
        except ValueError:
            raise RequestError(f"an obstacle is X,Z,RADIUS in metres, got {text!r}") from None
        return Obstacle((x, z), radius)

    def distance(self, ground: Float[Tensor, "*batch 2"]) -> Float[Tensor, "*batch"]:
        """Compute how far points (x, z) are from its edge, metres; negative within."""
        away = ground - ground.new_tensor(self.place)
        if self.size is None:
            return away.norm(dim=-1) - (self.radius or 0.0)
        angle = math.radians(self.turn_deg)
        turn = ground.new_tensor([[math.cos(angle), math.sin(angle)], [-math.sin(angle), math.cos(angle)]])
        beyond = (away @ turn).abs() - ground.new_tensor(self.size) / 2
        return beyond.clamp_min(0).norm(dim=-1) + beyond.amax(dim=-1).clamp_max(0)

    def outline(self) -> Float[Tensor, "points 2"]:
        """Return points around its edge, in order, metres."""
        if self.size is None:
            angle = torch.linspace(0, 2 * math.pi, 49, dtype=torch.float64)[:-1]
            edge = (self.radius or 0.0) * torch.stack([angle.sin(), angle.cos()], dim=1)
        else:
            corners = torch.tensor([[1, 1], [1, -1], [-1, -1], [-1, 1]], dtype=torch.float64)
            edge = corners * torch.tensor(self.size, dtype=torch.float64) / 2
        angle = math.radians(self.turn_deg)
        turn = edge.new_tensor([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
        return edge @ turn + edge.new_tensor(self.place)


def measure_clearance(obstacles: tuple[Obstacle, ...], ground: Float[Tensor, "*batch 2"]) -> Float[Tensor, "*batch"]:
    """Measure how far points (x, z) are from the nearest obstacle's edge, metres; infinity without any."""
    if not obstacles:
        return torch.full(ground.shape[:-1], torch.inf, dtype=ground.dtype)
    return torch.stack([obstacle.distance(ground) for obstacle in obstacles]).amin(dim=0)
