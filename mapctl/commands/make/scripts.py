"""Scripts of steering commands, drawn at random: what walks of one pace along a line lack."""

import math
from collections.abc import Callable

import torch

from mapctl.intent.steering import Command, CommandTrack
from mapctl.protocols import DataLimits

_HOLD = (1.5, 3.5)  # seconds for which a command holds
_STAND = 1.0  # seconds at the beginning
_SPIN = (60.0, 120.0)  # degrees a second on the spot
_VEER = (30.0, 120.0)  # degrees by which the direction changes under way
_LEAVE = (30.0, 180.0)  # degrees by which it changes with a start


def draw_script(limits: DataLimits, seconds: float, generator: torch.Generator) -> tuple[CommandTrack, str]:
    """A script of this length, and what it has in words: it begins with standing; then starts ahead and to other sides,
    stops, turns on the spot, changes of direction and of pace, within what the prior knows, follow each other, none
    twice in a row."""

    def uniform(low: float, high: float) -> float:
        return low + (high - low) * float(torch.rand((), generator=generator))

    time, heading, speed, words = _STAND, uniform(-math.pi, math.pi), 0.0, ["stand"]
    times, commands = [0.0], [Command(0.0, heading)]
    while time < seconds - _HOLD[0]:
        kinds = [kind for kind in _list_kinds(standing=speed == 0) if kind != words[-1].split()[0]]
        kind = kinds[int(torch.randint(len(kinds), (1,), generator=generator))]
        command, said = _draw_command(kind, limits, heading, speed, uniform)
        times.append(time)
        commands.append(command)
        words.append(f"{kind} {said}".strip())
        hold = uniform(*_HOLD)
        heading, speed = command.heading + (command.turning or 0.0) * hold, command.speed
        time += hold
    return CommandTrack(tuple(times), tuple(commands)), ", ".join(words)


def _list_kinds(*, standing: bool) -> list[str]:
    return ["go", "leave", "spin"] if standing else ["pace", "stop", "veer"]


def _draw_command(
    kind: str, limits: DataLimits, heading: float, speed: float, uniform: Callable[[float, float], float]
) -> tuple[Command, str]:
    """The command, and its numbers in words."""
    if kind == "stop":
        return Command(0.0, heading), ""
    if kind == "spin":
        rate = math.copysign(uniform(*_SPIN), uniform(-1, 1))
        return Command(0.0, heading, turning=math.radians(rate)), f"{rate:.0f} deg/s"
    if kind == "veer":
        by = math.copysign(uniform(*_VEER), uniform(-1, 1))
        return Command(speed, heading + math.radians(by)), f"{by:.0f} deg"
    pace = uniform(max(0.4, limits.slowest), limits.max_steering_speed)
    if kind == "leave":
        by = math.copysign(uniform(*_LEAVE), uniform(-1, 1))
        return Command(pace, heading + math.radians(by)), f"{pace:.2f} m/s to {by:.0f} deg"
    return Command(pace, heading), f"{pace:.2f} m/s"
