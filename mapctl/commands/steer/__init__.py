"""`mapctl steer`: a script of commands is replayed, as live steering would answer it."""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from mapctl.commands.shared import options
from mapctl.commands.shared.command import Command
from mapctl.intent.steering import SteeringLimits

_TURN_RATE_DEG = round(math.degrees(SteeringLimits.turn_rate), 1)


@dataclass(frozen=True)
class Steer(Command):
    """A character obeys a script of speeds and directions, answered as live steering would."""

    commands: Positional[Annotated[Path, arg(metavar="COMMANDS.csv")]]
    """CSV with the columns time_s, speed_mps, heading_deg (0 is +Z, 90 is +X); and, where wanted, facing_deg for
    strafing, turn_deg_s to turn on and on, step_m for a step length, gait and style as the prior knows them. The last
    line's time is the end."""
    out: options.OutFile
    """Where the motion goes: .bvh, .npz, .glb or .usda."""
    realtime: bool = False
    """Play against the wall clock: every step has a deadline and brings the best found by then. On a machine that
    cannot keep up the script's time goes slower than the clock's, and the summary says so."""
    prior: options.Name = "locomotion-live"
    """A bundled prior, or the file or run folder of a trained one."""
    rig: options.OutRig = "canonical"
    """Whose body moves: the canonical one, or that of a clip, on whose rig the motion is then written; or a rig by name
    or TOML file, whose joints get the canonical bones."""
    seed: options.Count = 0
    """Of the pose that it begins with."""
    acceleration: options.Number = SteeringLimits.acceleration
    """Most that the wanted speed rises by, m/s^2."""
    braking: options.Number = SteeringLimits.braking
    """Most that it falls by, m/s^2."""
    turn_rate: options.Number = _TURN_RATE_DEG
    """Most that the wanted direction turns by, degrees/s."""
    report: options.MaybeFile = None
    """JSON with each command's response, timing, ledger and measures."""
    plot: options.MaybeFile = None
    """PNG of wanted and got speed and direction over time."""
    strict: bool = False
    """Exit with status 3 where not all that was asked holds: a speed was lowered to what the prior can do, or a frame
    was late."""
    quiet: bool = False
    """No summary and no progress bar."""
