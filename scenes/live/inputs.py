"""Orders of a character and their limits: numbers and words of a page are checked here as they arrive."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from mapctl.intent.steering import STEP_LENGTHS, Command

UNCONDITIONED = "any"
"""The choice that gives a prior no label."""
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
    told: Mapping[str, str] = field(default_factory=dict)
    """Chosen label by group (gait, style)."""
    hand: str | None = None
    """Hand that reaches for the target, `left` or `right`; None for neither."""
    looks: bool = False
    """Whether the head looks at the target."""
    target: tuple[float, float, float] | None = None
    """Place of the target in the world, metres; None until there is one."""

    @property
    def command(self) -> Command:
        """Command for a LiveCharacter."""
        facing = None if self.facing is None else math.radians(self.facing)
        return Command(
            self.speed,
            math.radians(self.heading),
            facing,
            step_length=self.step_length,
            told=tuple(self.told.values()),
            reach={f"{self.hand}Hand": self.target} if self.hand and self.target else {},
            look_at=self.target if self.looks else None,
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

        `told` names a label by group, AS_IT_LIKES none; groups that it does not name stay as they are.
        """
        found, refused = {}, list[Refusal]()
        for name, asked in changes.items():
            held = self._label(orders.told, asked) if name == "told" else self._limit_number(orders, name, asked)
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

    def _label(self, told: Mapping[str, str], asked: Any) -> dict[str, str]:
        known = {group: (UNCONDITIONED, *labels) for group, labels in self.labels.items()}
        heard = {group: label for group, label in dict(asked).items() if label in known.get(group, ())}
        return {group: label for group, label in {**told, **heard}.items() if label != UNCONDITIONED}

    def _range(self, name: str) -> tuple[float, float]:
        return (0.0, self.fastest) if name == "speed" else self.steps

    def _explain_refusal(self, name: str, asked: Any, held: Any) -> str | None:
        """Return the refusal, None where the order holds as it was asked."""
        if name == "told":
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


def is_number(value: Any) -> bool:
    """Return whether what a browser sent is a finite number."""
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
