"""Keyframes: which frames of a motion count, and what of each does."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

from mapctl.errors import RequestError
from mapctl.motion import Motion

WorldPosition = tuple[float, float, float]
"""Position in a world with Y up, metres."""
KINDS = ("half", "drawing", "root_only")
"""What a key may be told by instead of a whole pose, one of them."""

NO_PLACE = "no key tells where the hips are: give one a pose, a half, or a place"
"""What is said where keys leave the place of the whole motion open."""


@dataclass(frozen=True)
class Drawing:
    """A pose as it is seen from one side."""

    places_xy: Mapping[str, tuple[float, float]]
    """Positions by joint, canonical names or the rig's own: to the viewer's right and up, in any unit."""
    view_deg: float = 0.0
    """Heading from the body to the viewer, degrees: from 0 one sees the face of who faces +Z."""

    def __post_init__(self):
        if not self.places_xy:
            raise RequestError("the drawing has no joints")
        for name, place in self.places_xy.items():
            if not all(map(math.isfinite, place)):
                raise RequestError(f"the drawing has {name} at {place}, which is no two finite numbers")
        if len({(float(x), float(y)) for x, y in self.places_xy.values()}) == 1:
            raise RequestError("the drawing has all joints at one point")
        if not math.isfinite(self.view_deg):
            raise RequestError(f"a drawing is seen from a heading in degrees, got {self.view_deg}")


@dataclass(frozen=True)
class Key:
    """A keyframe of a motion and which of it counts: the whole pose unless less is said."""

    frame: int
    """Frame of the motion."""
    limbs: tuple[str, ...] = ()
    """Joints of the rig, hands and feet, whose positions are all that counts."""
    places: Mapping[str, WorldPosition] = field(default_factory=dict)
    """Target positions of such joints in the world, metres, where the motion has them elsewhere."""
    root_only: bool | Literal["place"] = False
    """Whether only position and rotation of the hips count; of "place" only where they are over the ground."""
    half: Literal["upper", "lower"] | None = None
    """Half of the body that counts, with the hips; the other is made."""
    drawing: Drawing | None = None
    """What the pose looks like from one side; the motion's own frame does not count."""
    placed: bool = False
    """Whether with a drawing the place of the motion's hips over the ground counts."""

    def __post_init__(self):
        if self.ends and self.root_only:
            raise RequestError("keys of limbs and keys of the root only are two kinds; choose one")
        check_kinds({name: bool(getattr(self, name)) for name in KINDS}, bool(self.ends))
        if self.half not in (None, "upper", "lower"):
            raise RequestError(f"a half of the body is upper or lower, got {self.half!r}")
        if self.root_only not in (True, False, "place"):
            raise RequestError(f"root_only is True, False or 'place', got {self.root_only!r}")
        if self.placed and self.drawing is None:
            raise RequestError("placed is about keys with a drawing; others tell a place by what they are")
        for name, place in self.places.items():
            if not all(map(math.isfinite, place)):
                raise RequestError(f"the place of {name} at frame {self.frame} is no three numbers, got {place}")

    @property
    def ends(self) -> tuple[str, ...]:
        """All hands and feet whose positions count, if these are all that counts."""
        return tuple(dict.fromkeys((*self.limbs, *self.places)))

    @property
    def what(self) -> Literal["pose", "limbs", "root", "place", "half", "drawing"]:
        """What of the frame counts."""
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
            return any(name not in self.places for name in self.limbs)
        return self.what not in ("place", "drawing")

    @property
    def tells_place(self) -> bool:
        """Whether it tells where the hips are over the ground."""
        return self.placed if self.what == "drawing" else self.what != "limbs"


@dataclass(frozen=True)
class Keys:
    """Keyframes of a motion, and which of each counts."""

    each: tuple[Key | int, ...]
    """Keys in any order; a number is the frame of a whole pose. One of them at least tells where the hips are."""

    @staticmethod
    def of(frames: Sequence[int], *, limbs: tuple[str, ...] = (), root_only: bool = False) -> "Keys":
        """Make keys: the first and the last count whole, those between only by limbs or root if so asked."""
        if limbs and root_only:
            raise RequestError("keys of limbs and keys of the root only are two kinds; choose one")
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
        one frame, for fewer than two, and where none tells the hips' place."""
        found: dict[int, Key] = {}
        for one in self.each:
            key = Key(one) if isinstance(one, int) else one
            if not 0 <= key.frame < motion.num_frames:
                raise RequestError(f"the key {key.frame} is not one of the motion's frames 0:{motion.num_frames}")
            if found.setdefault(key.frame, key) != key:
                raise RequestError(f"two different keys are at frame {key.frame}")
        wanted = [found[frame] for frame in sorted(found)]
        if len(wanted) < 2:
            raise RequestError(f"in-betweening needs at least two keys, got {len(wanted)}")
        if not any(key.tells_place for key in wanted):
            raise RequestError(NO_PLACE)
        return wanted


def check_kinds(given: Mapping[str, bool], limbs: bool) -> None:
    """Raise RequestError where a key is told in two ways: by several of KINDS, or by one of them and by limbs."""
    told = [name for name in KINDS if given[name]]
    if len(told) > 1:
        raise RequestError(f"{' and '.join(told)} are {len(told)} kinds of keys; choose one")
    if told and limbs:
        raise RequestError(f"a key tells {told[0]} or hands and feet; choose one")
