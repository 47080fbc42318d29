"""Keys of a shot: what a character does at a time or for a while, as scene and key files tell it."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from os import PathLike
from typing import Annotated

from pydantic import Field

from mapctl.errors import FileFormatError
from mapctl.formats import toml
from mapctl.formats.toml import STRICT
from mapctl.skeleton import LIMBS

_MOST_SECONDS = 3600.0
_MOST_FRAMES = 108_000

Coordinate = Annotated[float, Field(ge=-1000, le=1000)]
Seconds = Annotated[float, Field(ge=0, le=_MOST_SECONDS)]
Place = tuple[Coordinate, Coordinate, Coordinate]


@dataclass(frozen=True)
class ShotKey:
    """What a character does at a time, or for a while."""

    __pydantic_config__ = STRICT

    seconds: Seconds | None = None
    """When, seconds since the first frame; or `frame`."""
    frame: Annotated[int, Field(ge=0, le=_MOST_FRAMES)] | None = None
    """Frame of the motion."""
    reach: Mapping[str, Place] = field(default_factory=dict)
    """Hands and feet (leftHand, rightHand, leftFoot, rightFoot) and where they are to be, x, y, z, metres."""
    look_at: Place | None = None
    """What the head looks at, x, y, z, metres."""
    hold_seconds: Seconds = 0.0
    """For how long."""
    tolerance: Annotated[float, Field(ge=0, le=10)] = 0.0
    """How far from its place a hand or a foot may stay, metres; 0 is exact."""

    @property
    def fault(self) -> str | None:
        """A fault that the types cannot express, after the key it is of; None without any."""
        if (self.seconds is None) == (self.frame is None):
            return "seconds: a key is at seconds or at a frame, one of them"
        if not self.reach and self.look_at is None:
            return "reach: a key tells a reach, a look_at or both"
        unknown = [name for name in self.reach if name not in LIMBS]
        return f"reach.{unknown[0]}: hands and feet are {', '.join(LIMBS)}" if unknown else None

    def at_seconds(self, fps: float) -> float:
        """Return when it is, seconds, of a motion at a rate."""
        return (self.frame or 0) / fps if self.seconds is None else self.seconds


@dataclass(frozen=True)
class _ShotKeyFile:
    """Contents of a key file of a shot."""

    __pydantic_config__ = STRICT

    key: Annotated[tuple[ShotKey, ...], Field(min_length=1, max_length=10_000)]
    """One [[key]] table each."""


def read_shot_keys(path: str | PathLike[str]) -> tuple[ShotKey, ...]:
    """Read the [[key]] tables of a TOML file; FileFormatError names file and key."""
    keys = toml.read(path, _ShotKeyFile, what="key file", unknown=_list_allowed_keys).key
    for number, key in enumerate(keys):
        if key.fault is not None:
            raise FileFormatError(path, f"key[{number}].{key.fault}")
    return keys


def _list_allowed_keys(key: Sequence[int | str]) -> str:
    known = fields(ShotKey if len(key) > 1 else _ShotKeyFile)
    return f"allowed: {', '.join(item.name for item in known)}"
