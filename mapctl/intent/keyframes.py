"""Keyframes: which frames of a motion count, and what of each does."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

from mapctl.errors import RequestError
from mapctl.motion import Motion

WorldPosition = tuple[float, float, float]
"""In a world that stands along Y, metres."""


@dataclass(frozen=True)
class Key:
    """A frame of a motion that counts, and what of it: the whole pose unless less is said."""

    frame: int
    """Of the motion."""
    limbs: tuple[str, ...] = ()
    """Joints of the rig, hands and feet, whose places are all that counts."""
    places: Mapping[str, WorldPosition] = field(default_factory=dict)
    """Of such joints, where they are to be, if that is not where the motion has them."""
    root_only: bool = False
    """Only the place and the rotation of the hips counts."""

    def __post_init__(self):
        if self.ends and self.root_only:
            raise RequestError("keys of limbs and keys of the root only are two kinds; choose one")
        for name, place in self.places.items():
            if not all(map(math.isfinite, place)):
                raise RequestError(f"the place of {name} at frame {self.frame} is no three numbers, got {place}")

    @property
    def ends(self) -> tuple[str, ...]:
        """All hands and feet that it tells the place of, if these are all that counts."""
        return tuple(dict.fromkeys((*self.limbs, *self.places)))

    @property
    def what(self) -> Literal["pose", "limbs", "root"]:
        """Of the frame counts."""
        return "limbs" if self.ends else "root" if self.root_only else "pose"

    @property
    def shown(self) -> bool:
        """Whether anything in the motion's own frame counts."""
        return self.what != "limbs" or any(name not in self.places for name in self.limbs)


@dataclass(frozen=True)
class Keys:
    """Which frames of a motion count, and what of them."""

    each: tuple[Key | int, ...]
    """In any order; a number is a whole pose. The first and the last in time must be whole."""

    @staticmethod
    def of(frames: Sequence[int], *, limbs: tuple[str, ...] = (), root_only: bool = False) -> "Keys":
        """The first and the last frame count whole, of those between only limbs or the root if so asked for."""
        if limbs and root_only:
            raise RequestError("keys of limbs and keys of the root only are two kinds; choose one")
        ends = (min(frames), max(frames)) if frames else ()
        return Keys(
            tuple(Key(frame) if frame in ends else Key(frame, limbs=limbs, root_only=root_only) for frame in frames)
        )

    @property
    def frames(self) -> tuple[int, ...]:
        """As they were given."""
        return tuple(key if isinstance(key, int) else key.frame for key in self.each)

    def checked(self, motion: Motion) -> list[Key]:
        """In the order of time, each once; RequestError for those that are not the motion's, for two that differ at one
        frame, for fewer than two, and where the first or the last is no whole pose.
        """
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
