"""Steering inputs of one character and their limits: what the page and other programs send is checked here."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from mapctl.intent.steering import STEP_LENGTHS, Command
from mapctl.streaming.orders import is_number

UNCONDITIONED = "any"
"""The choice that gives a prior no label."""
HANDS = ("left", "right")
DISC_RADII = (0.2, 2.0)
"""Smallest and largest disc to walk round, metres."""
WITHIN = (0.5, 10.0)
"""Shortest and longest time in which a character can be sent to a position, seconds."""
Point = tuple[float, float, float]
_MAX_COORDINATE = 1e4  # metres from the origin
_UNITS = {"speed": "m/s", "step_length": "m", "heading": "degrees", "facing": "degrees"}


@dataclass(frozen=True)
class SteeringInputs:
    """What one character is asked for, as the panel shows it."""

    speed: float = 1.2
    """Speed, m/s."""
    heading: float = 0.0
    """Direction of travel, degrees; 0 is +Z, 90 is +X."""
    facing: float | None = None
    """Facing, degrees; None faces the direction of travel."""
    step_length: float | None = None
    """Step length, metres; None leaves it to the prior."""
    labels: Mapping[str, str] = field(default_factory=dict)
    """Chosen label by group (gait, style)."""
    reach: Mapping[str, Point] = field(default_factory=dict)
    """Targets of hands in the world, metres, by `left` and `right`."""
    look_at: Point | None = None
    """Target of the head in the world, metres."""

    @property
    def command(self) -> Command:
        """Command for a LiveCharacter."""
        return Command(
            self.speed,
            math.radians(self.heading),
            None if self.facing is None else math.radians(self.facing),
            step_length=self.step_length,
            labels=tuple(f"{group}={label}" for group, label in self.labels.items()),
            reach={f"{hand}Hand": point for hand, point in self.reach.items()},
            look_at=self.look_at,
        )


@dataclass(frozen=True)
class InputLimits:
    """Limits of what can be asked of a prior."""

    fastest: float
    """Fastest speed, m/s."""
    labels: Mapping[str, Sequence[str]]
    """Labels of the prior, by group."""

    def change(self, inputs: SteeringInputs, changes: Mapping[str, Any]) -> tuple[SteeringInputs, list[str]]:
        """Change inputs by name, each limited to what is possible; also return a sentence for each that was limited.

        A value that is not a finite number changes nothing. `labels` holds a label by group, UNCONDITIONED for none.
        """
        found, notes = {}, list[str]()
        for name, asked in changes.items():
            if name == "labels":
                found[name], unknown = self._change_labels(inputs.labels, asked)
                notes += [f"{label!r} is not a {group} of this prior." for group, label in unknown.items()]
            elif is_number(asked):
                found[name] = self._limit(name, float(asked))
                if name in ("speed", "step_length") and found[name] != asked:
                    low, high = self._range(name)
                    words, unit = name.replace("_", " "), _UNITS[name]
                    notes.append(f"A {words} of {asked:g} {unit} is out of range: {low:g} to {high:g} {unit}.")
            elif asked is None and name in ("facing", "step_length"):
                found[name] = None
            else:
                notes.append(f"{str(asked)[:20]!r} is not a {name.replace('_', ' ')} in {_UNITS[name]}.")
        return replace(inputs, **found), notes

    def _range(self, name: str) -> tuple[float, float]:
        return (0.0, self.fastest) if name == "speed" else STEP_LENGTHS

    def _limit(self, name: str, value: float) -> float:
        if name in ("heading", "facing"):
            return value if abs(value) <= 180 else math.remainder(value, 360)
        low, high = self._range(name)
        return min(high, max(low, value))

    def _change_labels(
        self, labels: Mapping[str, str], asked: Mapping[str, str]
    ) -> tuple[dict[str, str], dict[str, str]]:
        known = {
            group: label
            for group, label in asked.items()
            if group in self.labels and label in (UNCONDITIONED, *self.labels[group])
        }
        changed = {group: label for group, label in {**labels, **known}.items() if label != UNCONDITIONED}
        return changed, {group: label for group, label in asked.items() if group not in known}


def parse_point(value: object) -> Point | None:
    """Return a position that a browser or another program sent, metres; None unless it is finite and near."""
    try:
        found = np.array(value, dtype=np.float64)
    except (TypeError, ValueError):
        return None
    if found.shape != (3,) or not np.isfinite(found).all() or np.abs(found).max() > _MAX_COORDINATE:
        return None
    return float(found[0]), float(found[1]), float(found[2])
