"""Keyframes: which frames of a motion count, what of each does, and the TOML and CSV files that hold them."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from os import PathLike
from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field

from mapctl.errors import FileFormatError, RequestError
from mapctl.formats import toml
from mapctl.formats.text import finite_number, read_table, shorten
from mapctl.formats.toml import STRICT
from mapctl.motion import Motion

WorldPosition = tuple[float, float, float]
"""Position in a world with Y up, metres."""
_KINDS = ("half", "drawing", "root_only")  # what a key may give instead of a whole pose, one of them
_NO_POSITION = "no key gives the position of the hips: give one a pose, a half, or a place"


@dataclass(frozen=True)
class Drawing:
    """A pose as it is seen from one side."""

    positions_xy: Mapping[str, tuple[float, float]]
    """Positions by joint, canonical names or the rig's own: to the viewer's right and up, in any unit."""
    view_deg: float = 0.0
    """Heading from the body to the viewer, degrees: from 0 one sees the face of a body that faces +Z."""

    def __post_init__(self):
        if not self.positions_xy:
            raise RequestError("the drawing has no joints")
        if not all(math.isfinite(value) for position in self.positions_xy.values() for value in position):
            raise RequestError("the drawing has a joint at a position that is no two finite numbers")
        if len({(float(x), float(y)) for x, y in self.positions_xy.values()}) == 1:
            raise RequestError("the drawing has all joints at one point")


@dataclass(frozen=True)
class Key:
    """A keyframe of a motion and which of it counts: the whole pose unless less is said."""

    frame: int
    """Frame of the motion."""
    limbs: tuple[str, ...] = ()
    """Joints of the rig, hands and feet, whose positions are all that counts."""
    positions: Mapping[str, WorldPosition] = field(default_factory=dict)
    """Target positions of such joints in the world, metres, where the motion has them elsewhere."""
    root_only: bool | Literal["place"] = False
    """Whether only position and rotation of the hips count; of "place" only where they are over the ground."""
    half: Literal["upper", "lower"] | None = None
    """Half of the body that counts, with the hips; the other is generated."""
    drawing: Drawing | None = None
    """Drawing of the pose from one side, in place of the motion's own frame."""
    placed: bool = False
    """Whether with a drawing the position of the motion's hips over the ground counts."""

    def __post_init__(self):
        if fault := _find_kind_fault(self, self.ends):
            raise RequestError(fault)
        for name, position in self.positions.items():
            if not all(map(math.isfinite, position)):
                raise RequestError(f"the position of {name} at frame {self.frame} is no three numbers, got {position}")

    @property
    def ends(self) -> tuple[str, ...]:
        """All hands and feet whose positions count, if these are all that counts."""
        return tuple(dict.fromkeys((*self.limbs, *self.positions)))

    @property
    def what(self) -> Literal["pose", "limbs", "root", "place", "half", "drawing"]:
        """The part of the frame that counts."""
        if self.ends:
            return "limbs"
        if self.drawing is not None:
            return "drawing"
        if self.half is not None:
            return "half"
        return "place" if self.root_only == "place" else "root" if self.root_only else "pose"

    @property
    def shown(self) -> bool:
        """Whether rotations or positions of joints in the motion's own frame count."""
        if self.what == "limbs":
            return any(name not in self.positions for name in self.limbs)
        return self.what not in ("place", "drawing")

    @property
    def gives_position(self) -> bool:
        """Whether it gives where the hips are over the ground."""
        return self.placed if self.what == "drawing" else self.what != "limbs"


@dataclass(frozen=True)
class Keys:
    """Keyframes of a motion, and which of each counts."""

    each: tuple[Key | int, ...]
    """Keys in any order; a number is the frame of a whole pose. One of them at least gives where the hips are."""

    @staticmethod
    def of(frames: Sequence[int], *, limbs: tuple[str, ...] = (), root_only: bool = False) -> "Keys":
        """Make keys: the first and the last count whole, those between only by limbs or root if so asked."""
        ends = (min(frames), max(frames)) if frames else ()
        return Keys(
            tuple(Key(frame) if frame in ends else Key(frame, limbs=limbs, root_only=root_only) for frame in frames)
        )

    @property
    def frames(self) -> tuple[int, ...]:
        """Frames of the keys, in the order in which they were given."""
        return tuple(key if isinstance(key, int) else key.frame for key in self.each)

    def checked(self, motion: Motion) -> list[Key]:
        """Sort keys by time, each once; RequestError for frames that the motion has not, for two keys that differ at
        one frame, for fewer than two, and where none gives the hips' position."""
        found: dict[int, Key] = {}
        for one in self.each:
            key = Key(one) if isinstance(one, int) else one
            if not 0 <= key.frame < motion.num_frames:
                raise RequestError(f"the key {key.frame} is not one of the motion's frames 0:{motion.num_frames}")
            if found.setdefault(key.frame, key) != key:
                raise RequestError(f"two different keys are at frame {key.frame}")
        if len(found) < 2:
            raise RequestError(f"in-betweening needs at least two keys, got {len(found)}")
        if not any(key.gives_position for key in found.values()):
            raise RequestError(_NO_POSITION)
        return [found[frame] for frame in sorted(found)]


_MOST_FRAMES = 100_000
_POSE_FIELDS = ("pose", "pose_frame", "pose_seconds", "place", "height", "facing_deg")
Metres = Annotated[float, Field(ge=-1000, le=1000)]
Degrees = Annotated[float, Field(ge=-3600, le=3600)]
Frame = Annotated[int, Field(ge=0, le=_MOST_FRAMES)]
Seconds = Annotated[float, Field(ge=0, le=3600)]
Name = Annotated[str, Field(min_length=1)]


@dataclass(frozen=True)
class KeyEntry:
    """One keyframe of a file: time, pose, position, and which of it counts."""

    __pydantic_config__ = STRICT

    frame: Frame | None = None
    """Frame of the key; or `seconds`."""
    seconds: Seconds | None = None
    """Time of the key, seconds, at the nearest frame."""
    pose: Name | None = None
    """A motion file, relative to the key file; that of the body if not given."""
    pose_frame: Frame | None = None
    """Frame of the pose in its file; or `pose_seconds`; the first if neither is given."""
    pose_seconds: Seconds | None = None
    """Time of the pose in its file, seconds."""
    place: tuple[Metres, Metres] | None = None
    """Hips position over the ground, x and z, metres; as in the pose's file if not given."""
    height: Annotated[float, Field(ge=-10, le=1000)] | None = None
    """Hips height, metres; as in the pose's file if not given."""
    facing_deg: Degrees | None = None
    """Hips heading, degrees: 0 along +Z, 90 along +X; as in the pose's file if not given."""
    joints: tuple[Name, ...] = ()
    """Hands and feet of the body whose positions in the pose are all that counts."""
    reach: Mapping[Name, tuple[Metres, Metres, Metres]] = field(default_factory=dict)
    """Hands and feet of the body with target positions x, y, z, metres: all that counts, as for `joints`."""
    root_only: bool | str = False
    """Whether only position and rotation of the hips count; "place": only where they are over the ground."""
    half: Literal["upper", "lower"] | None = None
    """Half of the body that counts, with the hips."""
    drawing: Name | None = None
    """A CSV file of joint,x,y, relative to the key file: what the pose looks like from one side."""
    view_deg: Degrees | None = None
    """Heading from the body to the viewer of the drawing, degrees; 0 if not given."""

    @property
    def needs_pose(self) -> bool:
        """Whether anything of a pose counts."""
        if self.drawing is not None or (self.root_only == "place" and self.place is not None):
            return False
        return not self.reach or any(name not in self.reach for name in self.joints)

    @property
    def gives_position(self) -> bool:
        """Whether it gives where the hips are over the ground."""
        return self.place is not None if self.drawing is not None else not (self.joints or self.reach)


@dataclass(frozen=True)
class KeyRequest:
    """Contents of a keyframe file."""

    __pydantic_config__ = STRICT

    key: Annotated[tuple[KeyEntry, ...], Field(max_length=10_000)]
    """One [[key]] table each, in any order."""
    body: Name | None = None
    """The motion file whose skeleton moves; the first pose's if not given."""
    fps: Annotated[float, Field(ge=0.01, le=1000)] = 30.0
    """Frame rate of the motion that is generated."""
    weights: Literal["free", "full"] | None = None
    """Set of bundled models, where the command names none; the environment's or the full one if not given."""

    def __post_init__(self):
        if len(self.key) < 2:
            raise RequestError(f"in-betweening needs at least two keys, got {len(self.key)}")
        for number, key in enumerate(self.key):
            if fault := _find_fault(key, self.body):
                raise RequestError(f"key[{number}].{fault}")
        if self.body is None and all(key.pose is None for key in self.key):
            raise RequestError("body: this key is needed where no key has a pose")
        frames = [self.frame_of(key) for key in self.key]
        for number, frame in enumerate(frames):
            if frame > _MOST_FRAMES:
                raise RequestError(f"key[{number}].seconds: a motion may have {_MOST_FRAMES} frames, got {frame}")
            if (other := frames.index(frame)) < number:
                raise RequestError(f"key[{number}]: key[{other}] is at frame {frame} already")
        if not any(key.gives_position for key in self.key):
            raise RequestError(_NO_POSITION)
        if (first := min(frames)) > 0:
            raise RequestError(
                f"key[{frames.index(first)}]: the motion begins with its first key, so that is at frame 0; got {first}"
            )

    @property
    def files(self) -> tuple[str, ...]:
        """All motion files and drawings that are read."""
        named = (self.body, *(key.pose for key in self.key), *(key.drawing for key in self.key))
        return tuple(dict.fromkeys(name for name in named if name is not None))

    def frame_of(self, key: KeyEntry) -> int:
        """Return the frame of a key."""
        return key.frame if key.frame is not None else round((key.seconds or 0.0) * self.fps)


def read_keys(path: str | PathLike[str]) -> KeyRequest:
    """Read the keyframe request of a file, the files that it names relative to its folder. FileFormatError names file
    and key."""

    def found(name: str | None) -> str | None:
        return None if name is None else str(Path(path).parent / name)

    try:
        request = toml.read(path, KeyRequest, what="key file")
    except RequestError as error:
        raise FileFormatError(path, str(error)) from error
    keys = (replace(key, pose=found(key.pose), drawing=found(key.drawing)) for key in request.key)
    return replace(request, body=found(request.body), key=tuple(keys))


def _find_kind_fault(key: Key | KeyEntry, ends: Sequence[str]) -> str | None:
    """Find a fault in what of a key counts: several of _KINDS, or one of them and hands and feet."""
    kinds = [name for name in _KINDS if getattr(key, name)]
    if key.root_only not in (True, False, "place"):
        return f'root_only: it is true, false or "place", got "{key.root_only}"'
    if len(kinds) > 1:
        return f"{kinds[0]}: {' and '.join(kinds)} are {len(kinds)} kinds of keys; choose one"
    return f"{kinds[0]}: a key gives {kinds[0]} or hands and feet; choose one" if kinds and ends else None


def _find_fault(key: KeyEntry, body: str | None) -> str | None:
    """Find a fault of a key that the types cannot express."""
    if (key.frame is None) == (key.seconds is None):
        return "frame: a key is at a frame or at seconds, one of them"
    if key.pose_frame is not None and key.pose_seconds is not None:
        return "pose_frame: a pose is given by pose_frame or by pose_seconds, not by both"
    if fault := _find_kind_fault(key, (*key.joints, *key.reach)):
        return fault
    if key.view_deg is not None and key.drawing is None:
        return "view_deg: it is the view of a drawing, and there is none"
    idle = [name for name in _POSE_FIELDS if getattr(key, name) is not None]
    if key.drawing is not None or key.root_only == "place":
        idle = [name for name in idle if name in ("height", "facing_deg") or (name != "place" and not key.needs_pose)]
    elif key.needs_pose:
        idle = []
    if idle:
        kind = "drawing" if key.drawing is not None else "place" if key.root_only else "position to reach"
        return f"{idle[0]}: of a key that is given by a {kind} it does not count; leave it out"
    if key.needs_pose and key.pose is None and body is None:
        return "pose: this key is needed where no body is given"
    return None


_COLUMNS = ("joint", "x", "y")


def read_drawing(path: str | PathLike[str], view_deg: float = 0.0) -> Drawing:
    """Read a drawing, x to the viewer's right and y up, in any unit. FileFormatError names file and line."""
    lines = read_table(path, f"a CSV of the columns {','.join(_COLUMNS)}")
    header, names = (lines[0][0], [word.lower() for word in lines[0][1]]) if lines else (1, [])
    if sorted(names) != sorted(_COLUMNS):
        found = shorten(",".join(names))
        raise FileFormatError(path, f"found the columns {found}, expected {','.join(_COLUMNS)}, each once", header)
    positions: dict[str, tuple[float, float]] = {}
    for number, words in lines[1:]:
        if len(words) != len(names):
            raise FileFormatError(path, f"found {len(words)} values where {len(names)} belong", number)
        row = dict(zip(names, words, strict=True))
        if not row["joint"] or row["joint"] in positions:
            raise FileFormatError(path, f"each line names a joint, each once, got {shorten(row['joint'])}", number)
        x, y = finite_number(row["x"]), finite_number(row["y"])
        if x is None or y is None:
            axis = "x" if x is None else "y"
            raise FileFormatError(path, f"{axis} must be a finite number, got {shorten(row[axis])}", number)
        positions[row["joint"]] = (x, y)
    try:
        return Drawing(positions, view_deg)
    except RequestError as error:
        raise FileFormatError(path, str(error)) from error
