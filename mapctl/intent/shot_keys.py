"""Keys of a shot: what a character does at a time or for a while, as scene and key files give it."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from os import PathLike
from typing import Annotated, Literal

from pydantic import Field

from mapctl.errors import FileFormatError
from mapctl.formats import toml
from mapctl.formats.toml import STRICT
from mapctl.skeleton import LIMBS

_MOST_SECONDS = 3600.0
_MOST_FRAMES = 108_000
_MOST_SHIFT = 600

Coordinate = Annotated[float, Field(ge=-1000, le=1000)]
Seconds = Annotated[float, Field(ge=0, le=_MOST_SECONDS)]
Tolerance = Annotated[float, Field(ge=0, le=180)]
Position = tuple[Coordinate, Coordinate, Coordinate]


@dataclass(frozen=True)
class ShotKey:
    """A keyframe of a shot: a reach, a look or a pose at a time, or held."""

    __pydantic_config__ = STRICT

    seconds: Seconds | None = None
    """When, seconds since the first frame; or `frame`."""
    frame: Annotated[int, Field(ge=0, le=_MOST_FRAMES)] | None = None
    """Frame of the motion."""
    reach: Mapping[str, Position] = field(default_factory=dict)
    """Hands and feet (leftHand, rightHand, leftFoot, rightFoot) and where they are to be, x, y, z, metres."""
    pose: Annotated[str, Field(min_length=1)] | None = None
    """A motion file, relative to the file of the key, of which a frame is the pose."""
    pose_frame: Annotated[int, Field(ge=0, le=_MOST_FRAMES)] = 0
    """Frame of the pose in its file."""
    place: tuple[Coordinate, Coordinate] | None = None
    """Hips over the ground, x and z, metres; on the trajectory if not given."""
    height: Annotated[float, Field(ge=0, le=10)] | None = None
    """Height of the hips, metres; that of the pose if not given."""
    facing_deg: Annotated[float, Field(ge=-3600, le=3600)] | None = None
    """Heading of the hips, degrees: 0 along +Z, 90 along +X; that of a pose is along the trajectory if not given."""
    joints: tuple[str, ...] = ()
    """Hands and feet whose positions in the pose are all that counts of it."""
    root_only: bool = False
    """Whether only position and rotation of the pose's hips count."""
    look_at: Position | None = None
    """Target of the gaze, x, y, z, metres."""
    hold_seconds: Seconds = 0.0
    """For how long."""
    tolerance: Tolerance | Mapping[str, Tolerance] = 0.0
    """How far from there a joint may be, metres, of all or by hand and foot; degrees of a key that gives a facing and
    nothing else; 0 is exact."""
    within_frames: Annotated[int, Field(ge=0, le=_MOST_SHIFT)] = 0
    """How many frames of the motion earlier or later it may be."""

    @property
    def fault(self) -> str | None:
        """A fault that the types cannot express, after the key it is of; None without any."""
        tolerated = self.tolerance if isinstance(self.tolerance, Mapping) else {}
        limbs = {"reach": self.reach, "joints": self.joints, "tolerance": tolerated}
        idle = {"pose_frame": self.pose_frame, "joints": self.joints, "root_only": self.root_only}
        if (self.seconds is None) == (self.frame is None):
            return "seconds: a key is at seconds or at a frame, one of them"
        if not (self.reach or self.look_at or self.gives_hips):
            return "reach: a key gives a reach, a look_at, a pose, or a place, a height or a facing of the hips"
        if self.pose is None and any(idle.values()):
            return f"{next(name for name, value in idle.items() if value)}: this is of a pose, and the key has none"
        if self.root_only and self.joints:
            return "root_only: of a pose only the hips count, or some joints; choose one"
        for name, given in limbs.items():
            if unknown := [limb for limb in given if limb not in LIMBS]:
                return f"{name}.{unknown[0]}: hands and feet are {', '.join(LIMBS)}"
        if unused := [limb for limb in tolerated if limb not in {*self.reach, *self.joints}]:
            return f"tolerance.{unused[0]}: the key has no position for it"
        return None

    @property
    def gives_hips(self) -> bool:
        """Whether it gives a pose, or position, height or facing of the hips."""
        return any(value is not None for value in (self.pose, self.place, self.height, self.facing_deg))

    def at_seconds(self, fps: float) -> float:
        """Return when it is, seconds, of a motion at a rate."""
        return (self.frame or 0) / fps if self.seconds is None else self.seconds


@dataclass(frozen=True)
class ShotKeyFile:
    """Contents of a key file of a shot."""

    __pydantic_config__ = STRICT

    key: Annotated[tuple[ShotKey, ...], Field(min_length=1, max_length=10_000)]
    """One [[key]] table each."""
    weights: Literal["free", "full"] | None = None
    """Set of bundled models, where the command gives none; the environment's or the full one if not given."""

    @staticmethod
    def read(path: str | PathLike[str]) -> "ShotKeyFile":
        """Read a TOML file of keys; FileFormatError names file and key."""
        found = toml.read(path, ShotKeyFile, what="key file")
        for number, key in enumerate(found.key):
            if key.fault is not None:
                raise FileFormatError(path, f"key[{number}].{key.fault}")
        return found
