"""Ground that is not flat: boxes, ramps, stairs and a height field, read from a TOML file."""

import math
from dataclasses import dataclass, replace
from functools import cached_property
from os import PathLike
from pathlib import Path
from typing import Annotated

import numpy as np
import scipy
import torch
from jaxtyping import Float
from numpy import ndarray
from pydantic import Field
from torch import Tensor

from mapctl.errors import FileFormatError
from mapctl.formats import toml
from mapctl.formats.toml import STRICT

Coordinate = Annotated[float, Field(ge=-1000, le=1000)]
Length = Annotated[float, Field(gt=0, le=1000)]
Height = Annotated[float, Field(ge=-10, le=10)]


@dataclass(frozen=True, kw_only=True)
class Box:
    """A level of some height: a kerb, a platform."""

    __pydantic_config__ = STRICT

    centre: tuple[Coordinate, Coordinate]
    """x and z, metres."""
    size: tuple[Length, Length]
    """Width and depth, along x and along z before it is turned, metres."""
    height: Height
    """Height of its top over the floor, metres."""
    heading_deg: float = 0.0
    """Turn about its centre, degrees; positive turns +Z toward +X."""


@dataclass(frozen=True, kw_only=True)
class Ramp:
    """A slope of constant gradient between two heights."""

    __pydantic_config__ = STRICT

    start: tuple[Coordinate, Coordinate]
    """Middle of one end, x and z, metres."""
    end: tuple[Coordinate, Coordinate]
    """Middle of the other end."""
    heights: tuple[Height, Height]
    """Heights of both ends over the floor, metres."""
    width: Length = 2.0
    """Width, metres."""


@dataclass(frozen=True, kw_only=True)
class Stairs:
    """Steps that rise along a heading; the last one is a tread like the others."""

    __pydantic_config__ = STRICT

    start: tuple[Coordinate, Coordinate]
    """Middle of the lower edge of the first step, x and z, metres."""
    steps: Annotated[int, Field(ge=1, le=200)]
    """Number of steps."""
    rise: Annotated[float, Field(gt=0, le=1)]
    """Height of a step, metres."""
    tread: Annotated[float, Field(ge=0.1, le=10)]
    """Depth of a step, metres."""
    width: Length = 2.0
    """Width, metres."""
    heading_deg: float = 0.0
    """Direction in which they rise, degrees from +Z toward +X."""
    base: Height = 0.0
    """Height of the ground that they rise from, metres."""


@dataclass(frozen=True, kw_only=True)
class HeightImage:
    """A grey picture as a height field: columns along +X, rows along +Z, bilinear between pixels."""

    __pydantic_config__ = STRICT

    file: Annotated[str, Field(min_length=1)]
    """PNG file, relative to the TOML file."""
    size: tuple[Length, Length]
    """Extent along x and along z, metres."""
    white: Height
    """Height of white over the floor, metres; black is the floor."""
    centre: tuple[Coordinate, Coordinate] = (0.0, 0.0)
    """Middle of the picture, x and z, metres."""


_SHORTEST = 0.01  # metres of a ramp


@dataclass(frozen=True, eq=False)
class Slab:
    """A rectangle on the ground with a plane as its top."""

    centre: Float[ndarray, "2"]
    """x and z, metres."""
    along: Float[ndarray, "2"]
    """Unit vector of its own z axis."""
    half: Float[ndarray, "2"]
    """Half of its width and of its depth, metres."""
    heights: tuple[float, float]
    """Heights of its top at both ends of its depth, metres."""

    def to_own(self, points: Float[ndarray, "*batch 2"]) -> Float[ndarray, "*batch 2"]:
        """Return points of the floor along its own axes, from its centre."""
        away, (x, z) = points - self.centre, self.along
        return np.stack([away @ np.array([z, -x]), away @ self.along], axis=-1)

    def corners(self) -> Float[ndarray, "4 3"]:
        """Return the corners of its top, counter-clockwise seen from above."""
        (x, z), (width, depth), (low, high) = self.along, self.half, self.heights
        own = np.array([[-width, -depth], [-width, depth], [width, depth], [width, -depth]])
        ground = self.centre + own @ np.array([[z, -x], [x, z]])
        return np.insert(ground, 1, [low, high, high, low], axis=1)


@dataclass(frozen=True)
class Ground:
    """Heights over the floor y = 0: the highest of all parts at each point, and the floor beside them."""

    __pydantic_config__ = STRICT

    boxes: tuple[Box, ...] = ()
    """Levels, one [[boxes]] table each."""
    ramps: tuple[Ramp, ...] = ()
    """Slopes, one [[ramps]] table each."""
    stairs: tuple[Stairs, ...] = ()
    """Stairs, one [[stairs]] table each."""
    image: HeightImage | None = None
    """A height field, an [image] table."""

    @staticmethod
    def read(path: str | PathLike[str]) -> "Ground":
        """Read a TOML file. FileFormatError names file and key."""
        return toml.read(path, Ground, what="ground file").located(path)

    def located(self, path: str | PathLike[str]) -> "Ground":
        """Return the ground with its picture beside the file that it was read from; FileFormatError where a part cannot
        be."""
        for number, ramp in enumerate(self.ramps):
            if math.dist(ramp.start, ramp.end) < _SHORTEST:
                raise FileFormatError(path, f"ramps[{number}].end: a ramp is {100 * _SHORTEST:g} cm long at least")
        if self.image is None:
            if not self.slabs:
                raise FileFormatError(path, "holds no ground: give boxes, ramps, stairs or an image")
            return self
        found = replace(self, image=replace(self.image, file=str(Path(path).parent / self.image.file)))
        _ = found._pixels  # so that a fault is found now
        return found

    @cached_property
    def slabs(self) -> tuple[Slab, ...]:
        """Boxes, ramps and steps as slabs."""
        found = [
            Slab(np.array(box.centre), _direction(box.heading_deg), np.array(box.size) / 2, (box.height, box.height))
            for box in self.boxes
        ]
        for ramp in self.ramps:
            ends, length = np.array([ramp.start, ramp.end]), math.dist(ramp.start, ramp.end)
            half = np.array([ramp.width, length]) / 2
            found.append(Slab(ends.mean(axis=0), (ends[1] - ends[0]) / length, half, ramp.heights))
        for stairs in self.stairs:
            along = _direction(stairs.heading_deg)
            for step in range(stairs.steps):
                centre = np.array(stairs.start) + (step + 0.5) * stairs.tread * along
                height = stairs.base + (step + 1) * stairs.rise
                found.append(Slab(centre, along, np.array([stairs.width, stairs.tread]) / 2, (height, height)))
        return tuple(found)

    @cached_property
    def _pixels(self) -> Float[ndarray, "rows columns"]:
        """Heights of the pixels, metres."""
        from PIL import Image

        assert self.image is not None
        try:
            with Image.open(self.image.file) as picture:
                deep = picture.mode.startswith("I")  # 16 bits
                grey = np.asarray(picture if deep else picture.convert("L"), dtype=float)
        except (OSError, ValueError, Image.DecompressionBombError) as error:
            raise FileFormatError(self.image.file, "is not a picture that can be read") from error
        if min(grey.shape) < 2:
            raise FileFormatError(self.image.file, "a height field has 2 pixels a side at least")
        return grey * (self.image.white / (65535.0 if deep else 255.0))

    def height(self, points: Float[Tensor, "*batch 2"]) -> Float[Tensor, "*batch"]:
        """Return the heights at points of the floor (x, z), metres."""
        at = points.detach().double().numpy()
        found = np.full(at.shape[:-1], -np.inf)
        if self.image is not None:
            pixels, size = self._pixels, np.array(self.image.size)
            share = (at - np.array(self.image.centre)) / size + 0.5
            inside = ((share >= 0) & (share <= 1)).all(axis=-1)
            index = np.moveaxis(share[..., ::-1] * np.array(pixels.shape) - 0.5, -1, 0)
            field = scipy.ndimage.map_coordinates(pixels, index.reshape(2, -1), order=1, mode="nearest")
            found = np.where(inside, field.reshape(inside.shape), found)
        for slab in self.slabs:
            own = slab.to_own(at)
            inside = (np.abs(own) <= slab.half + 1e-9).all(axis=-1)
            share = own[..., 1] / (2 * slab.half[1]) + 0.5
            top = slab.heights[0] + (slab.heights[1] - slab.heights[0]) * share
            found = np.where(inside, np.maximum(found, top), found)
        return torch.from_numpy(np.where(np.isfinite(found), found, 0.0)).to(points)


def _direction(heading_deg: float) -> Float[ndarray, "2"]:
    angle = math.radians(heading_deg)
    return np.array([math.sin(angle), math.cos(angle)])
