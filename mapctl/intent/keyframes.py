"""Keyframes: which frames of a motion count, and what of each does."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

from mapctl.errors import RequestError
from mapctl.motion import Motion

WorldPosition = tuple[float, float, float]
"""Position in a world with Y up, metres."""


@dataclass(frozen=True)
class Key:
    """A keyframe of a motion and which of it counts: the whole pose unless less is said."""

    frame: int
    """Frame of the motion."""
    limbs: tuple[str, ...] = ()
    """Joints of the rig, hands and feet, whose positions are all that counts."""
    places: Mapping[str, WorldPosition] = field(default_factory=dict)
    """Target positions of such joints, where the motion has them elsewhere."""
    root_only: bool = False
    """Whether only position and rotation of the hips count."""

    def __post_init__(self):
        if self.ends and self.root_only:
            raise RequestError("keys of limbs and keys of the root only are two kinds; choose one")
        for name, place in self.places.items():
            if not all(map(math.isfinite, place)):
                raise RequestError(f"the place of {name} at frame {self.frame} is no three numbers, got {place}")

    @property
    def ends(self) -> tuple[str, ...]:
        """All hands and feet whose positions count, if these are all that counts."""
        return tuple(dict.fromkeys((*self.limbs, *self.places)))

    @property
    def what(self) -> Literal["pose", "limbs", "root"]:
        """Whether all of the frame counts."""
        return "limbs" if self.ends else "root" if self.root_only else "pose"

    @property
    def shown(self) -> bool:
        """Whether anything in the motion's own frame counts."""
        return self.what != "limbs" or any(name not in self.places for name in self.limbs)


@dataclass(frozen=True)
class Keys:
    """Keyframes of a motion, and which of each counts."""

    each: tuple[Key | int, ...]
    """In any order; a number is a whole pose. The first and the last in time must be whole."""

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
        """Keys as they were given."""
        return tuple(key if isinstance(key, int) else key.frame for key in self.each)

    def checked(self, motion: Motion) -> list[Key]:
        """Sort keys by time, each once; RequestError for frames that the motion has not, for two keys that differ at
        one frame, for fewer than two, and where the first or the last is no whole pose."""
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
        for key in (wanted[0], wanted[-1]):
            if key.what != "pose":
                raise RequestError(
                    f"the first and the last key are whole poses; that at frame {key.frame} tells the {key.what} only"
                )
        return wanted
