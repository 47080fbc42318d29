"""Sigmas of steering that can be changed while a character moves."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from controllers.steering.loop import Stepper
from controllers.steering.steer import SteerFrames, SteerSettings, SteerState
from mapctl.errors import RequestError
from mapctl.intent.steering import Command
from mapctl.runtime.live_protocol import SigmaRange

_WIDEST = 16.0  # times smaller, and larger, than a sigma of the settings
_DESCRIBED = {
    "speed": ("Speed", "m/s"),
    "direction": ("Direction", "rad"),
    "facing": ("Facing", "rad"),
    "foot speed": ("Planted foot's speed", "m/s"),
    "foot height": ("Planted foot's height", "m"),
    "foot below": ("Foot below the ground", "m"),
    "noise": ("Latent noise", ""),
}


def describe_sigmas(settings: SteerSettings) -> Sequence[SigmaRange]:
    """Describe the sigmas of these settings, which are their defaults; each can be 16 times smaller or larger."""
    found = _read(settings)
    return [
        SigmaRange(name, label, unit, found[name], found[name] / _WIDEST, found[name] * _WIDEST)
        for name, (label, unit) in _DESCRIBED.items()
    ]


def check_sigmas(settings: SteerSettings, values: Mapping[str, float]) -> None:
    """Check values against the ranges of `describe_sigmas`; RequestError says what is allowed."""
    ranges = {one.name: one for one in describe_sigmas(settings)}
    for name, value in values.items():
        if name not in ranges:
            raise RequestError(f"there is no sigma {name!r}, only {', '.join(ranges)}")
        one = ranges[name]
        if not (math.isfinite(value) and one.low <= value <= one.high):
            raise RequestError(one.explain_refusal(value))


def change_sigmas(settings: SteerSettings, values: Mapping[str, float]) -> SteerSettings:
    """Return the settings with these sigmas, by name, in metres and radians; the others are the settings' own."""
    now = {**_read(settings), **values}
    footing = settings.footing.with_sigmas(now["foot speed"], now["foot height"], now["foot below"])
    return replace(
        settings,
        sigma_speed=now["speed"],
        sigma_direction=now["direction"],
        sigma_facing=now["facing"],
        footing=footing,
        noise=replace(settings.noise, sigma=now["noise"]),
    )


@dataclass
class TunedStepper:
    """A Stepper whose sigmas can be changed between two steps."""

    stepper: Stepper
    """Maker of the frames."""
    settings: SteerSettings
    """Settings in the character's size, whose sigmas are the defaults."""
    _changed: SteerSettings | None = None

    def tune(self, values: Mapping[str, float]) -> None:
        """Use these sigmas from the next step on, and the defaults of those that are not named; RequestError where one
        is out of its range."""
        check_sigmas(self.settings, values)
        self._changed = change_sigmas(self.settings, values)

    def __call__(
        self, state: SteerState, command: Command, *, seconds: float | None = None
    ) -> tuple[SteerState, SteerFrames]:
        """See Stepper."""
        if self._changed is not None:
            state = replace(state, settings=self._changed.scaled_to(state.character))
        return self.stepper(state, command, seconds=seconds)


def _read(settings: SteerSettings) -> dict[str, float]:
    return {
        "speed": settings.sigma_speed,
        "direction": settings.sigma_direction,
        "facing": settings.sigma_facing,
        "foot speed": settings.footing.sigma_speed,
        "foot height": settings.footing.sigma_height,
        "foot below": settings.footing.sigma_below,
        "noise": settings.noise.sigma,
    }
