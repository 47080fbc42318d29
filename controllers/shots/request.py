"""Requests for shots: several wishes that hold at once."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from itertools import combinations

from jaxtyping import Float
from torch import Tensor

from controllers.shots.lead import Lead
from mapctl.curves import Curve
from mapctl.curves.obstacles import Obstacle
from mapctl.errors import RequestError
from mapctl.features import PRIOR_FPS
from mapctl.intent.keyframes import WorldPosition
from mapctl.intent.path import SpeedProfile
from mapctl.intent.timed_speed import TimedSpeed
from mapctl.skeleton import LIMBS

_SAME_PLACE = 0.05  # metres


@dataclass(frozen=True)
class Reach:
    """Hands or feet at places, for a moment or held."""

    seconds: float
    """When, seconds since the first frame."""
    places: Mapping[str, WorldPosition]
    """Canonical hands and feet and where they are to be, world, metres."""
    hold_seconds: float = 0.0
    """For how long they stay there."""
    tolerance: float = 0.0
    """How far from there they may be, metres; 0 is exact."""

    def __post_init__(self):
        unknown = [name for name in self.places if name not in LIMBS]
        if unknown or not self.places:
            raise RequestError(f"hands and feet that reach are {', '.join(LIMBS)}; got {', '.join(unknown) or 'none'}")


@dataclass(frozen=True)
class Look:
    """The head looks at a place for a while."""

    seconds: float
    """When, seconds since the first frame."""
    place: WorldPosition
    """What it looks at, world, metres."""
    hold_seconds: float = 0.0
    """For how long."""


@dataclass(frozen=True, eq=False)
class Others:
    """Others who move, and how far to stay away from them."""

    hips: Float[Tensor, "others frames 2"]
    """Their hips on the ground from this shot's first frame on, at PRIOR_FPS, x and z, metres; the last frame holds."""
    distance: float
    """Least distance of hips, metres."""


@dataclass(frozen=True, eq=False)
class ShotRequest:
    """What one character is asked to do."""

    curve: Curve
    """Curve to walk, world, metres."""
    speed: SpeedProfile | TimedSpeed = field(default_factory=lambda: SpeedProfile.constant(1.2))
    """Speed along it."""
    seconds: float | None = None
    """Duration, seconds; None walks the curve once."""
    lead: Lead | None = None
    """A clip to go on from, which ends where the curve begins; None begins anew."""
    stand_at_start: bool = False
    """Whether it begins standing at ease; if not it begins in its stride."""
    stand_at_end: bool = False
    """Whether it ends standing at ease."""
    reaches: tuple[Reach, ...] = ()
    """Places for hands and feet."""
    looks: tuple[Look, ...] = ()
    """Places to look at."""
    obstacles: tuple[Obstacle, ...] = ()
    """Obstacles to walk around."""
    others: Others | None = None
    """Others to keep apart from."""

    @property
    def _start(self) -> Float[Tensor, "2"]:
        return self.curve.start[:: self.curve.dims - 1]

    @property
    def begins_standing(self) -> bool:
        """Whether it begins standing: at ease, or as the clip does that it goes on from."""
        return self.stand_at_start or (self.lead is not None and self.lead.stands)

    def __post_init__(self):
        if self.seconds is None and isinstance(self.speed, TimedSpeed):
            raise RequestError("speeds by time need the shot's seconds")
        if self.lead is not None and self.stand_at_start:
            raise RequestError("a shot goes on from a clip or begins standing, not both")
        for key in (*self.reaches, *self.looks):
            if self.seconds is not None and not 0 <= key.seconds <= self.seconds - key.hold_seconds:
                what = "reach" if isinstance(key, Reach) else "look"
                raise RequestError(
                    f"a {what} from {key.seconds:g} s to {key.seconds + key.hold_seconds:g} s is not within "
                    f"the shot's {self.seconds:g} s"
                )
        for one, other in combinations(self.reaches, 2):
            _check_contradiction(one, other)
        inside = [obstacle for obstacle in self.obstacles if float(obstacle.distance(self._start)) < 0]
        if inside:
            raise RequestError(f"the obstacle at {inside[0].place[0]:g}, {inside[0].place[1]:g} stands on the start")


def _check_contradiction(one: Reach, other: Reach) -> None:
    """Raise RequestError for a limb that is to be at two places within two frames."""
    first, second = sorted((one, other), key=lambda reach: reach.seconds)
    if second.seconds - first.seconds - first.hold_seconds > 2 / PRIOR_FPS:
        return
    for name in first.places.keys() & second.places.keys():
        apart = math.dist(first.places[name], second.places[name])
        if apart > _SAME_PLACE:
            raise RequestError(
                f"{name} is to be at two places {100 * apart:.0f} cm apart within two frames, at {first.seconds:g} s "
                f"and at {second.seconds:g} s"
            )
