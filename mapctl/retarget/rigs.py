"""Known rigs, one TOML each: which of their joints is which canonical one, and what their T-pose is."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cache
from importlib.resources import as_file, files
from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import Field

from mapctl.errors import FileFormatError, RequestError
from mapctl.formats import toml
from mapctl.formats.text import shorten
from mapctl.joint_names import describe_nearest
from mapctl.skeleton import CANONICAL, Skeleton

AXES = ("x", "y", "z", "-x", "-y", "-z")
RESTS = ("auto", "tpose", "straighten", "frame0")
UNITS = {"m": 1.0, "dm": 0.1, "cm": 0.01, "mm": 0.001, "in": 0.0254}
"""Names of length units that a rig's TOML may use, in metres."""


@dataclass(frozen=True, kw_only=True)
class _RigSettings:
    """What a rig and its file have alike."""

    about: str = ""
    also: tuple[str, ...] = ()
    """Further joints of the rig, that distinguish it from its relatives."""
    trunk: tuple[str, ...] = ()
    """Joints between spine and chest, upwards."""
    up: str = "auto"
    """Axis of the file's world that points up: one of AXES; `auto` to find it."""
    facing: str = "auto"
    """Axis of the file that the rest pose faces: one of AXES; `auto` to find it."""
    rest: str = "auto"
    """Where the T-pose comes from: `tpose` (all rotations zero is one, as it is), `straighten` (all zero, with the
    limbs straightened), `frame0` (the clip begins with one), or `auto` (the table of the T-pose, else what fits)."""


@dataclass(frozen=True)
class Rig(_RigSettings):
    """Names, T-pose and axes of a rig, as known before any file of it is read."""

    name: str
    """Name by which users call the rig."""
    joints: Mapping[str, str]
    """Canonical joint name to the rig's own."""
    tpose: Mapping[str, Mapping[str, list[float]]] = field(default_factory=dict)
    """Canonical joint name to where the joint's local x and y axes point in the T-pose; others as in the rest pose."""
    idle: Mapping[str, list[float]] = field(default_factory=dict)
    """Local rotation (xyzw) in the T-pose by the rig's own joint; none for joints that are canonical or left out."""
    aliases: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    """Canonical joint name to the other names that versions of the rig use, one entry a version."""
    metres_per_unit: float | None = None
    """Length of the file's unit, metres; None to find it by the size of the body."""

    def __post_init__(self):
        for key, value, allowed in (("up", self.up, AXES), ("facing", self.facing, AXES), ("rest", self.rest, RESTS)):
            if value not in {"auto", *allowed}:
                raise RequestError(f"rig {self.name}: {key} is one of auto, {', '.join(allowed)}, got {value!r}")
        strange = [name for name in (*self.joints, *self.tpose) if name not in CANONICAL.names]
        if strange:
            near = describe_nearest(strange[0], CANONICAL.names)
            raise RequestError(f"rig {self.name}: no canonical joint {shorten(strange[0])}; {near}")

    def with_fields_of(self, other: "Rig") -> "Rig":
        """Return the rig with up axis, facing, rest pose and unit of another one, where that one has them."""
        own = {name: getattr(other, name) for name in ("up", "facing", "rest", "metres_per_unit")}
        return replace(self, **{name: value for name, value in own.items() if value not in ("auto", None)})

    def fits(self, skeleton: Skeleton) -> bool:
        """Return whether the skeleton has every joint that the rig names, spelled as the rig does."""
        return set(self.joints.values()) <= set(skeleton.names)


@cache
def known_rigs() -> tuple[Rig, ...]:
    """Return every rig in this folder, the canonical one first."""
    canonical = Rig(
        "canonical",
        {name: name for name in CANONICAL.names},
        rest="tpose",
        about="The canonical skeleton: VRM names, a T-pose with all rotations zero.",
    )
    with as_file(files("mapctl.retarget").joinpath("presets")) as folder:
        return canonical, *(read_rig_toml(path) for path in sorted(folder.glob("*.toml")))


def read_rig_toml(path: Path) -> Rig:
    """Read a rig from a TOML file; FileFormatError names what is wrong with it."""
    try:
        return toml.read(path, _RigFile, what="rig file").build(path.stem)
    except RequestError as error:
        raise FileFormatError(path, str(error)) from None


_Component = Annotated[float, Field(ge=-1e3, le=1e3)]


@dataclass(frozen=True)
class _Axes:
    """Where a joint's local x and y axes point in the T-pose."""

    __pydantic_config__ = toml.STRICT

    x: tuple[_Component, _Component, _Component]
    y: tuple[_Component, _Component, _Component]

    def __post_init__(self):
        if np.linalg.norm(np.cross(self.x, self.y)) < 1e-6:
            raise RequestError(f"tpose: x and y must be two directions, got {self.x} and {self.y}")


_Names = str | Annotated[tuple[str, ...], Field(min_length=1)]


@dataclass(frozen=True)
class _RigFile(_RigSettings):
    """Contents of a rig file; a joint may have several names, one a version of the rig."""

    __pydantic_config__ = toml.STRICT

    name: str = ""
    left: _Names = ""
    """What `*` stands for in names of the left side, one a version of the rig; the last serves further ones."""
    right: _Names = ""
    joints: Mapping[str, _Names] = field(default_factory=dict)
    """Names by canonical joint; without its side, as UpperArm, for both."""
    tpose: Mapping[str, _Axes] = field(default_factory=dict)
    unit: float | str = "auto"

    def build(self, name: str) -> Rig:
        """Return the rig, of this name if it has none of its own."""
        sides = {"left": _as_tuple(self.left), "right": _as_tuple(self.right)}
        given = {joint: _as_tuple(own) for joint, own in self.joints.items()}
        parts = [joint for joint in given if "left" + joint in CANONICAL.names]
        names = {joint: own for joint, own in given.items() if joint not in parts}
        for side, words in sides.items():
            for part in parts:
                spelled = tuple(_spell(own, words, version) for version, own in enumerate(given[part]))
                names.setdefault(side + part, spelled)
        for part in parts:
            if names["left" + part] == names["right" + part]:
                raise RequestError(f"joints: {part} is one joint on both sides; give left, right and * in its name")
        settings = {item.name: getattr(self, item.name) for item in fields(_RigSettings)}
        settings["also"] = tuple({_spell(own, words, 0): None for own in self.also for words in sides.values()})
        return Rig(
            name=self.name or name,
            joints={joint: own[0] for joint, own in names.items()},
            aliases={joint: own[1:] for joint, own in names.items() if len(own) > 1},
            tpose={joint: {"x": [*axes.x], "y": [*axes.y]} for joint, axes in self.tpose.items()},
            metres_per_unit=parse_unit(self.unit),
            **settings,
        )


def _as_tuple(names: _Names) -> tuple[str, ...]:
    return (names,) if isinstance(names, str) else names


def _spell(name: str, words: Sequence[str], version: int) -> str:
    """Spell a name for the side of these words."""
    return name.replace("*", words[min(version, len(words) - 1)])


def parse_unit(unit: str | float | None) -> float | None:
    """Parse the name of a unit, or metres per unit; None for `auto` and None; RequestError for anything else."""
    if unit in (None, "auto"):
        return None
    try:
        metres = UNITS.get(str(unit)) or float(unit)
    except ValueError:
        metres = math.nan
    if not 1e-6 < metres < 1e6:
        raise RequestError(f"a unit is {', '.join(UNITS)} or metres per unit, got {unit!r}")
    return metres
