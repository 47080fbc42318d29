"""Orders of a character and their limits: numbers and words of a page are checked here as they arrive."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from mapctl.intent.steering import STEP_LENGTHS, Command
from mapctl.numerics.checks import is_number

UNCONDITIONED = "any"
"""The choice that gives a prior no label."""
Place = tuple[float, float, float]
HANDS = ("left", "right")
"""Hands that reach for a target."""
DISC_RADII = (0.2, 2.0)
"""Smallest and largest disc to walk round, metres."""
WITHIN = (0.5, 10.0)
"""Shortest and longest time in which somebody can be sent anywhere, seconds."""
_MAX_COORDINATE = 1e4  # metres from the origin beyond which nobody looks
_NUMBER_FIELDS = ("speed", "heading", "facing", "step_length")
_WORDS_AND_UNITS = {"speed": ("speed", "m/s"), "step_length": ("step length", "m")}


@dataclass(frozen=True)
class SteeringInputs:
    """Orders of one character, as the panel shows them."""

    speed: float = 1.2
    """Speed, m/s."""
    heading: float = 0.0
    """Direction of travel, degrees; 0 is +Z, 90 is +X."""
    facing: float | None = None
    """Facing, degrees; None faces where it goes."""
    step_length: float | None = None
    """Step length, metres; None leaves it to the prior."""
    labels: Mapping[str, str] = field(default_factory=dict)
    """Chosen label by group (gait, style)."""
    hand: str | None = None
    """Hand that reaches for the target, `left` or `right`; None for neither."""
    looks: bool = False
    """Whether the head looks at the target."""
    target: tuple[float, float, float] | None = None
    """Place of the target in the world, metres; None until there is one."""
    reach: Mapping[str, tuple[float, float, float]] = field(default_factory=dict)
    """Places that hands reach for because a program said so, metres, by `left` and `right`; the target comes before."""
    look_at: tuple[float, float, float] | None = None
    """Place that the head looks at because a program said so; likewise."""

    @property
    def command(self) -> Command:
        """Command for a LiveCharacter."""
        facing = None if self.facing is None else math.radians(self.facing)
        reach = {**self.reach, **({self.hand: self.target} if self.hand and self.target else {})}
        return Command(
            self.speed,
            math.radians(self.heading),
            facing,
            step_length=self.step_length,
            labels=tuple(f"{group}={label}" for group, label in self.labels.items()),
            reach={f"{hand}Hand": place for hand, place in reach.items()},
            look_at=self.target if self.looks else self.look_at,
        )


@dataclass(frozen=True)
class Refusal:
    """A note for whoever asked for what cannot be done."""

    name: str
    """Name of the order."""
    held: Any
    """Value that holds instead."""
    text: str
    """Sentence with what is allowed."""


@dataclass(frozen=True)
class InputLimits:
    """Limits of what can be asked of a prior."""

    fastest: float
    """Fastest speed, m/s."""
    labels: Mapping[str, Sequence[str]]
    """Labels that the prior knows, by group."""
    steps: tuple[float, float] = STEP_LENGTHS
    """Shortest and longest step, metres."""

    def changed(self, orders: SteeringInputs, changes: Mapping[str, Any]) -> tuple[SteeringInputs, list[Refusal]]:
        """Change orders by name, each limited to what can be done; what is no number changes nothing.

        `labels` names a label by group, AS_IT_LIKES none; groups that it does not name stay as they are.
        """
        found, refused = {}, list[Refusal]()
        for name, asked in changes.items():
            held = self._label(orders.labels, asked) if name == "labels" else self._limit_number(orders, name, asked)
            if (text := self._explain_refusal(name, asked, held)) is not None:
                refused.append(Refusal(name, held, text))
            found[name] = held
        return replace(orders, **found), refused

    def _limit_number(self, orders: SteeringInputs, name: str, asked: Any) -> float | None:
        if name not in _NUMBER_FIELDS or not is_number(asked):
            may_be_none = name in ("facing", "step_length") and asked is None
            return None if may_be_none else getattr(orders, name)
        if name in ("heading", "facing"):
            return float(asked) if abs(asked) <= 180 else math.remainder(asked, 360)
        lowest, highest = self._range(name)
        return min(highest, max(lowest, float(asked)))

    def _label(self, labels: Mapping[str, str], asked: Any) -> dict[str, str]:
        known = {group: (UNCONDITIONED, *labels) for group, labels in self.labels.items()}
        heard = {group: label for group, label in dict(asked).items() if label in known.get(group, ())}
        return {group: label for group, label in {**labels, **heard}.items() if label != UNCONDITIONED}

    def _range(self, name: str) -> tuple[float, float]:
        return (0.0, self.fastest) if name == "speed" else self.steps

    def _explain_refusal(self, name: str, asked: Any, held: Any) -> str | None:
        """Return the refusal, None where the order holds as it was asked."""
        if name == "labels":
            return next(
                (
                    f"{label!r} is not a {group} that this prior knows."
                    for group, label in dict(asked).items()
                    if held.get(group, UNCONDITIONED) != label
                ),
                None,
            )
        if asked == held:
            return None
        if not is_number(asked):
            held = "none" if held is None else f"{held:g}"
            return f"{name.replace('_', ' ').capitalize()}: {str(asked)[:20]!r} is no number; {held} holds."
        if name not in _WORDS_AND_UNITS:
            return f"A {name} of {asked:g} degrees is the same as {held:g}."
        words, unit = _WORDS_AND_UNITS[name]
        low, high = self._range(name)
        way = "raised" if held > asked else "lowered"
        return f"A {words} of {asked:g} {unit} was {way} to {held:g}: it can be {low:g} to {high:g} {unit}."


def parse_place(place: object) -> Place | None:
    """Return a place that a browser or another program sent, metres; None where it is none near the stage."""
    try:
        found = np.array(place, dtype=np.float64)
    except (TypeError, ValueError):
        return None
    if found.shape != (3,) or not np.isfinite(found).all() or np.abs(found).max() > _MAX_COORDINATE:
        return None
    return float(found[0]), float(found[1]), float(found[2])
