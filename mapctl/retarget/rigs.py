"""Known rigs, one TOML each: which of their joints is which canonical one, and what their T-pose is."""

import math
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Any

from mapctl.errors import FileFormatError, RequestError
from mapctl.formats.text import read_bytes
from mapctl.joint_names import describe_nearest
from mapctl.skeleton import CANONICAL, Skeleton

AXES = ("x", "y", "z", "-x", "-y", "-z")
RESTS = ("auto", "tpose", "straighten", "frame0")
UNITS = {"m": 1.0, "dm": 0.1, "cm": 0.01, "mm": 0.001, "in": 0.0254}
"""Names of length units that a rig's TOML may use, in metres."""
_KEYS = {"name", "about", "also", "trunk", "joints", "tpose", "straighten", "end_sites", "up", "facing", "rest", "unit"}


@dataclass(frozen=True)
class Rig:
    """Names, T-pose and axes of a rig, as known before any file of it is read."""

    name: str
    """Name by which users call the rig."""
    joints: Mapping[str, str]
    """Canonical joint name to the rig's own."""
    tpose: Mapping[str, Mapping[str, list[float]]] = field(default_factory=dict)
    """Canonical joint name to where the joint's local x and y axes point in the T-pose; the zero pose if absent."""
    straighten: tuple[str, ...] = ()
    """Canonical joints whose bone is rotated to its canonical direction in the T-pose."""
    end_sites: tuple[str, ...] = ()
    """Canonical joints that the rig has only as the End Site of their canonical parent."""
    about: str = ""
    """Description of the rig, one line."""
    aliases: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    """Canonical joint name to the other names that versions of the rig use, one entry a version."""
    also: tuple[str, ...] = ()
    """Further joints of the rig, that distinguish it from its relatives."""
    up: str = "auto"
    """Axis of the file's world that points up: one of AXES; `auto` to find it."""
    facing: str = "auto"
    """Axis of the file that the rest pose faces: one of AXES; `auto` to find it."""
    rest: str = "auto"
    """Where the T-pose comes from: `tpose` (all rotations zero is one, as it is), `straighten` (all zero, with the
    limbs straightened), `frame0` (the clip begins with one), or `auto` (a table or list above, else what fits)."""
    metres_per_unit: float | None = None
    """Length of the file's unit, metres; None to find it by the size of the body."""
    trunk: tuple[str, ...] = ()
    """Joints between spine and chest, upwards."""

    def __post_init__(self):
        for key, value, allowed in (("up", self.up, AXES), ("facing", self.facing, AXES), ("rest", self.rest, RESTS)):
            if value not in {"auto", *allowed}:
                raise RequestError(f"rig {self.name}: {key} is one of auto, {', '.join(allowed)}, got {value!r}")
        strange = [name for name in (*self.joints, *self.tpose, *self.straighten) if name not in CANONICAL.names]
        if strange:
            near = describe_nearest(strange[0], CANONICAL.names)
            raise RequestError(f"rig {self.name}: no canonical joint {strange[0]!r}; {near}")

    @property
    def has_tpose(self) -> bool:
        """Whether the T-pose is given, so that it need not be found."""
        return bool(self.tpose or self.straighten or self.rest == "tpose") and self.rest in ("auto", "tpose")

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
    paths = sorted(
        (p for p in files("mapctl.retarget").joinpath("presets").iterdir() if p.name.endswith(".toml")),
        key=lambda p: p.name,
    )
    return canonical, *(_rig_from_table(tomllib.loads(path.read_text("utf-8"))) for path in paths)


def find_preset(name: str) -> Rig | None:
    """Return the known rig of this name, in any case; None where there is none."""
    return next((rig for rig in known_rigs() if rig.name == name.lower()), None)


def read_rig_toml(path: Path) -> Rig:
    """Read a rig from a TOML file; FileFormatError says what is wrong with it."""
    try:
        return _rig_from_table({"name": path.stem, **tomllib.loads(read_bytes(path).decode("utf-8"))})
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise FileFormatError(path, f"is no TOML: {error}") from None
    except RequestError as error:
        raise FileFormatError(path, str(error)) from None


def _rig_from_table(table: Mapping[str, Any]) -> Rig:
    strange = sorted(table.keys() - _KEYS)
    if strange:
        raise RequestError(f"a rig has no {strange[0]!r}; it may have {', '.join(sorted(_KEYS))}")
    joints = table.get("joints", {})
    if not isinstance(joints, dict):
        raise RequestError("a rig's joints are a table of canonical names and the rig's own")
    names = {canonical: _parse_names(canonical, own) for canonical, own in joints.items()}
    return Rig(
        table["name"],
        {canonical: own[0] for canonical, own in names.items()},
        table.get("tpose", {}),
        tuple(table.get("straighten", ())),
        tuple(table.get("end_sites", ())),
        table.get("about", ""),
        {canonical: own[1:] for canonical, own in names.items() if len(own) > 1},
        tuple(table.get("also", ())),
        table.get("up", "auto"),
        table.get("facing", "auto"),
        table.get("rest", "auto"),
        parse_unit(table.get("unit")),
        trunk=tuple(table.get("trunk", ())),
    )


def _parse_names(canonical: str, own: Any) -> tuple[str, ...]:
    names = (own,) if isinstance(own, str) else tuple(own) if isinstance(own, list) else ()
    if not names or not all(isinstance(name, str) for name in names):
        raise RequestError(f"{canonical} is the rig's name for it, or a list of names, got {own!r}")
    return names


def parse_unit(unit: Any) -> float | None:
    """Parse the name of a unit, or metres per unit; None for `auto` and None; RequestError for anything else."""
    if unit in (None, "auto"):
        return None
    try:
        metres = UNITS[unit] if unit in UNITS else math.nan if isinstance(unit, bool) else float(unit)
    except (TypeError, ValueError):  # a list or a table, a word
        metres = math.nan
    if not 1e-6 < metres < 1e6:
        raise RequestError(f"a unit is {', '.join(UNITS)} or metres per unit, got {unit!r}")
    return metres
