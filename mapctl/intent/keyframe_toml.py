"""Keyframe files: poses with time and position, for in-betweening. TOML, checked before any work."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from difflib import get_close_matches
from os import PathLike
from pathlib import Path
from typing import Annotated

from pydantic import Field

from mapctl.errors import FileFormatError, RequestError
from mapctl.formats import toml
from mapctl.formats.toml import STRICT

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
    root_only: bool = False
    """Whether only position and rotation of the hips count."""

    @property
    def needs_pose(self) -> bool:
        """Whether anything of a pose counts."""
        return not self.reach or any(name not in self.reach for name in self.joints)


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

    def __post_init__(self):
        if len(self.key) < 2:
            raise RequestError(f"in-betweening needs at least two keys, got {len(self.key)}")
        for number, key in enumerate(self.key):
            fault = _find_fault(key, self.body)
            if fault is not None:
                raise RequestError(f"key[{number}].{fault}")
        frames = [self.frame_of(key) for key in self.key]
        for number, frame in enumerate(frames):
            if frame > _MOST_FRAMES:
                raise RequestError(f"key[{number}].seconds: a motion may have {_MOST_FRAMES} frames, got {frame}")
            if (other := frames.index(frame)) < number:
                raise RequestError(f"key[{number}]: key[{other}] is at frame {frame} already")
        for number in (frames.index(min(frames)), frames.index(max(frames))):
            if self.key[number].joints or self.key[number].reach or self.key[number].root_only:
                raise RequestError(
                    f"key[{number}]: the first and the last key in time are whole poses, without "
                    "joints, reach or root_only"
                )
        if min(frames) > 0:
            first = frames.index(min(frames))
            raise RequestError(
                f"key[{first}]: the motion begins with its first key, so that is at frame 0; got {frames[first]}"
            )

    @property
    def files(self) -> tuple[str, ...]:
        """All motion files that are read."""
        named = (self.body, *(key.pose for key in self.key))
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

    return replace(
        request, body=found(request.body), key=tuple(replace(key, pose=found(key.pose)) for key in request.key)
    )


def _find_fault(key: KeyEntry, body: str | None) -> str | None:
    """Find faults that the types cannot express."""
    if (key.frame is None) == (key.seconds is None):
        return "frame: a key is at a frame or at seconds, one of them"
    if key.pose_frame is not None and key.pose_seconds is not None:
        return "pose_frame: a pose is told by pose_frame or by pose_seconds, not by both"
    if key.root_only and (key.joints or key.reach):
        return "root_only: a key tells the root or some joints; choose one"
    idle = [name for name in _POSE_FIELDS if getattr(key, name) is not None]
    if idle and not key.needs_pose:
        return f"{idle[0]}: of a key that only reaches, no pose counts; leave it out"
    if key.needs_pose and key.pose is None and body is None:
        return "pose: this key is needed where no body is given"
    return None


def _suggest_key(key: Sequence[int | str]) -> str:
    names = [item.name for item in fields(KeyEntry if len(key) > 1 else KeyRequest)]
    near = get_close_matches(str(key[-1]), names, n=1, cutoff=0)
    return f"the nearest is {near[0]}; allowed: {', '.join(names)}"
