"""`mapctl steer`: a script of commands is replayed, as live steering would answer it."""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, UseAppendAction, arg

from mapctl.commands.shared import options
from mapctl.commands.shared.command import ModelCommand
from mapctl.intent.steering_limits import SteeringLimits

_TURN_RATE_DEG = round(math.degrees(SteeringLimits.turn_rate), 1)


@dataclass(frozen=True)
class Steer(ModelCommand, options.ReadOptions):
    """A character follows a script of speeds and directions, as in live steering."""

    commands: Positional[Annotated[Path, arg(metavar="COMMANDS.csv")]]
    """CSV with the columns time_s, speed_mps, heading_deg (0 is +Z, 90 is +X); and, where wanted, facing_deg for
    strafing, turn_deg_s to turn continuously, step_m for a step length, gait and style as the prior knows them,
    left_hand_x, left_hand_y, left_hand_z (and right_hand_, look_) for a place in metres that a hand reaches or that is
    looked at. goto_x_m, goto_z_m, within_s, and where wanted goto_facing_deg and pose (FILE:FRAME), say where the hips
    are to be first, and within how many seconds: the rest of the line holds from then on. The last line's time is the
    end, or a second after the last place is reached."""
    out: options.OutFile
    """Where the motion goes: .bvh, .npz, .glb or .usda."""
    realtime: bool = False
    """Play against the wall clock: every step has a deadline and brings the best found by then. On a machine that
    cannot keep up the script's time runs slower than the clock's, and the summary says so."""
    stream: options.MaybeEndpoint = None
    """With --realtime: where poses go over the VMC protocol, each frame when it is due (most programs receive at port
    39539). A port alone is on this machine."""
    stream_root: bool = False
    """Let the root travel over the ground in the stream, and not the hips."""
    stream_delay: options.Number = 0.1
    """Seconds by which the stream is behind, so that a frame that is computed late is not sent late."""
    prior: options.Name = "locomotion-live"
    """A bundled prior, or the file or run folder of a trained one."""
    stitcher: options.MaybeName = None
    """For goto_x_m: the file or run folder of a trained stitcher, which makes the end of the way; the bundled one if
    not given."""
    rig: options.OutRig = "canonical"
    """Body that moves: the canonical one, or that of a clip, on whose rig the motion is then written; or a rig by name
    or TOML file, whose joints get the canonical bones."""
    avoid: Annotated[UseAppendAction[tuple[str, ...]], arg(metavar="X,Z,RADIUS")] = ()
    """A disc on the ground to walk around, metres; may be given several times."""
    seed: options.Count = 0
    """Seed of the first pose."""
    acceleration: options.Number = SteeringLimits.acceleration
    """Largest acceleration of the target speed, m/s^2."""
    braking: options.Number = SteeringLimits.braking
    """Largest deceleration of the target speed, m/s^2."""
    turn_rate: options.Number = _TURN_RATE_DEG
    """Largest turn rate of the target direction, degrees/s."""
    report: options.MaybeFile = None
    """JSON with each command's response, timing, ledger and measures."""
    strict: bool = False
    """Exit with status 3 where not all that was requested holds: a speed was lowered to what the prior can do, or a
    frame was late."""
    quiet: bool = False
    """No summary and no progress bar."""
