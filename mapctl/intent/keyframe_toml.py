"""Keyframe files: poses with time and position, for in-betweening. TOML, checked before any work."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from difflib import get_close_matches
from os import PathLike
from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field

from mapctl.errors import FileFormatError, RequestError
from mapctl.formats import toml
from mapctl.formats.text import finite_number, read_table, shorten
from mapctl.formats.toml import STRICT
from mapctl.intent.keyframes import KINDS, NO_PLACE, Drawing, check_kinds

_MOST_SECONDS = 3600.0
_MOST_FRAMES = 100_000

_POSE_FIELDS = ("pose", "pose_frame", "pose_seconds", "place", "height", "facing_deg")

Metres = Annotated[float, Field(ge=-1000, le=1000)]
Frame = Annotated[int, Field(ge=0, le=_MOST_FRAMES)]
Seconds = Annotated[float, Field(ge=0, le=_MOST_SECONDS)]
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
    facing_deg: Annotated[float, Field(ge=-3600, le=3600)] | None = None
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
    view_deg: Annotated[float, Field(ge=-3600, le=3600)] | None = None
    """Heading from the body to who sees it as the drawing has it, degrees; 0 if not given."""

    @property
    def needs_pose(self) -> bool:
        """Whether anything of a pose counts."""
        if self.drawing is not None or (self.root_only == "place" and self.place is not None):
            return False
        return not self.reach or any(name not in self.reach for name in self.joints)

    @property
    def tells_place(self) -> bool:
        """Whether it tells where the hips are over the ground."""
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
    """Frame rate of the motion that is made."""
    weights: Literal["free", "full"] | None = None
    """Set of bundled models, where the command does not tell; the environment's or the full one if not given."""

    def __post_init__(self):
        if len(self.key) < 2:
            raise RequestError(f"in-betweening needs at least two keys, got {len(self.key)}")
        for number, key in enumerate(self.key):
            fault = _find_fault(key, self.body)
            if fault is not None:
                raise RequestError(f"key[{number}].{fault}")
        if self.body is None and all(key.pose is None for key in self.key):
            raise RequestError("body: this key is needed where no key has a pose")
        frames = [self.frame_of(key) for key in self.key]
        for number, frame in enumerate(frames):
            if frame > _MOST_FRAMES:
                raise RequestError(f"key[{number}].seconds: a motion may have {_MOST_FRAMES} frames, got {frame}")
            if (other := frames.index(frame)) < number:
                raise RequestError(f"key[{number}]: key[{other}] is at frame {frame} already")
        if not any(key.tells_place for key in self.key):
            raise RequestError(NO_PLACE)
        if min(frames) > 0:
            first = frames.index(min(frames))
            raise RequestError(
                f"key[{first}]: the motion begins with its first key, so that is at frame 0; got {frames[first]}"
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
    try:
        request = toml.read(path, KeyRequest, what="key file", unknown=_suggest_key)
    except RequestError as error:
        raise FileFormatError(path, str(error)) from error
    folder = Path(path).parent

    def found(name: str | None) -> str | None:
        return None if name is None else str(folder / name)

    keys = (replace(key, pose=found(key.pose), drawing=found(key.drawing)) for key in request.key)
    return replace(request, body=found(request.body), key=tuple(keys))


def _find_fault(key: KeyEntry, body: str | None) -> str | None:
    """Find faults that the types cannot express."""
    if (key.frame is None) == (key.seconds is None):
        return "frame: a key is at a frame or at seconds, one of them"
    if key.pose_frame is not None and key.pose_seconds is not None:
        return "pose_frame: a pose is told by pose_frame or by pose_seconds, not by both"
    return _find_kind_fault(key) or _find_pose_fault(key, body)


def _find_kind_fault(key: KeyEntry) -> str | None:
    """Find faults in what of a key counts."""
    if key.root_only not in (True, False, "place"):
        return f'root_only: it is true, false or "place", got "{key.root_only}"'
    if key.root_only and (key.joints or key.reach):
        return "root_only: a key tells the root or some joints; choose one"
    try:
        check_kinds({name: bool(getattr(key, name)) for name in KINDS}, bool(key.joints or key.reach))
    except RequestError as error:
        return f"{next(name for name in KINDS if getattr(key, name))}: {error}"
    if key.view_deg is not None and key.drawing is None:
        return "view_deg: it says from where a drawing is seen, and there is none"
    return None


def _find_pose_fault(key: KeyEntry, body: str | None) -> str | None:
    """Find faults in the pose of a key and in where it is put."""
    idle = [name for name in _POSE_FIELDS if getattr(key, name) is not None]
    loose = key.drawing is not None or key.root_only == "place"
    if loose:
        idle = [name for name in idle if name in ("height", "facing_deg") or (name != "place" and not key.needs_pose)]
    if idle and loose:
        kind = "drawing" if key.drawing is not None else "place alone"
        return f"{idle[0]}: of a key that is told by a {kind} it does not count; leave it out"
    if idle and not key.needs_pose:
        return f"{idle[0]}: of a key that only reaches, no pose counts; leave it out"
    if key.needs_pose and key.pose is None and body is None:
        return "pose: this key is needed where no body is given"
    return None


def _suggest_key(key: Sequence[int | str]) -> str:
    names = [item.name for item in fields(KeyEntry if len(key) > 1 else KeyRequest)]
    near = get_close_matches(str(key[-1]), names, n=1, cutoff=0)
    return f"the nearest is {near[0]}; allowed: {', '.join(names)}"


_COLUMNS = ("joint", "x", "y")


def read_drawing(path: str | PathLike[str], view_deg: float = 0.0) -> Drawing:
    """Read a drawing, x to the viewer's right and y up, in any unit. FileFormatError names file and line."""
    lines = read_table(path, f"a CSV of the columns {','.join(_COLUMNS)}")
    header, names = (lines[0][0], [word.lower() for word in lines[0][1]]) if lines else (1, [])
    if sorted(names) != sorted(_COLUMNS):
        found = shorten(",".join(names))
        raise FileFormatError(path, f"found the columns {found}, expected {','.join(_COLUMNS)}, each once", header)
    places: dict[str, tuple[float, float]] = {}
    for number, words in lines[1:]:
        if len(words) != len(names):
            raise FileFormatError(path, f"found {len(words)} values where {len(names)} belong", number)
        told = dict(zip(names, words, strict=True))
        if not told["joint"] or told["joint"] in places:
            raise FileFormatError(path, f"each line names a joint, each once, got {shorten(told['joint'])}", number)
        x, y = (_read_number(path, number, axis, told[axis]) for axis in ("x", "y"))
        places[told["joint"]] = (x, y)
    try:
        return Drawing(places, view_deg)
    except RequestError as error:
        raise FileFormatError(path, str(error)) from error


def _read_number(path: str | PathLike[str], line: int, axis: str, word: str) -> float:
    value = finite_number(word)
    if value is None:
        raise FileFormatError(path, f"{axis} must be a finite number, got {shorten(word)}", line)
    return value
