"""`mapctl drive`: a robot does at once what a character does whose poses come over the VMC protocol."""

import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import torch
from tyro.conf import Positional, arg

from mapctl import rotations
from mapctl.commands.shared import options, streaming
from mapctl.commands.shared.command import Command
from mapctl.features import PRIOR_FPS
from mapctl.robots import model
from mapctl.robots.files import build_rows
from mapctl.robots.following import DELAY_FRAMES, RobotFollower
from mapctl.skeleton import CANONICAL
from mapctl.streaming.messages import Message

if TYPE_CHECKING:
    from mapctl.streaming.receiver import OscReceiver
    from mapctl.streaming.sender import VmcFrame

ADDRESS = "/mapctl/robot"
"""Address of a frame: the stream's time, then the numbers of a row of a robot's .csv."""
_FRAMES, _MOST_FRAMES = 3, 15  # that are solved at once, as steering computes them; where it is behind, all that came


@dataclass(frozen=True)
class Drive(Command):
    """Drive a robot live by a character's poses, as mapctl live and mapctl steer --realtime stream them over the VMC
    protocol; Ctrl-C ends."""

    robot: Positional[Annotated[Path, arg(metavar="ROBOT")]]
    """The robot, as MJCF or URDF."""
    stream: Annotated[str, arg(metavar="HOST:PORT")]
    """Where the robot's frames go, 30 a second over OSC: /mapctl/robot, the time in seconds, position of the base,
    its quaternion (xyzw), joint angles in the model's order. A port alone is on this machine."""
    listen: Annotated[str, arg(metavar="HOST:PORT")] = "39539"
    """Where the character's poses come from: a port alone takes those of this machine."""
    quiet: options.Quiet = False


def run(command: Drive) -> int:
    """Check, drive until Ctrl-C, and print what came and went."""
    driver, what = Driver(model.load(command.robot)), f"as those of {command.robot.stem}"
    with streaming.open_relay(command.stream, command.listen, what=what, quiet=command.quiet) as (receiver, send):
        _drive(driver, receiver, send)
    return 0


class Driver:
    """The robot's side of a stream: it has no socket and no clock."""

    def __init__(self, robot: model.Robot):
        from mapctl.streaming.sender import FrameAssembler

        self._robot, self._assembler = robot, FrameAssembler()
        self._waiting: list[VmcFrame] = []
        self._follower: RobotFollower | None = None
        self._times: deque[float] = deque(maxlen=DELAY_FRAMES + _MOST_FRAMES)

    def take(self, messages: list[Message]) -> list[Message]:
        """Take what came; return the robot's frames, DELAY_FRAMES behind."""
        frames = [frame for message in messages if (frame := self._assembler.take(message)) is not None]
        self._waiting += frames
        if len(self._waiting) < _FRAMES:
            return []
        given, self._waiting = self._waiting[-_MOST_FRAMES:], []
        offsets = torch.from_numpy(given[0].bone_positions)
        if self._follower is None:
            skeleton = replace(CANONICAL, offsets=torch.cat([torch.zeros(1, 3, dtype=torch.float64), offsets[1:]]))
            self._follower = RobotFollower(self._robot, skeleton)
        root, turn, hips = (
            torch.stack([torch.from_numpy(values) for values in rows])
            for rows in zip(*((f.root_position, f.root_quat_xyzw, f.bone_positions[0]) for f in given), strict=True)
        )
        quats = torch.stack([torch.from_numpy(frame.bone_quats_xyzw) for frame in given])
        quats[:, 0] = rotations.multiply(turn, quats[:, 0])
        self._times.extend(frame.seconds for frame in given)
        found = self._follower.push(root + rotations.rotate(turn, hips), quats)
        if found is None:
            return []
        count = len(found.angles)
        times = list(self._times)[-DELAY_FRAMES - count : -DELAY_FRAMES]
        return [Message(ADDRESS, (at, *row)) for at, row in zip(times, build_rows(found).tolist(), strict=True)]


def _drive(driver: Driver, receiver: "OscReceiver", send: Callable[[bytes], None]) -> None:
    from mapctl.streaming.sender import bundle, encode

    waiting, due = deque[Message](), time.perf_counter()
    while True:
        waiting.extend(driver.take(receiver.poll()))
        now = time.perf_counter()
        while waiting and now >= due:  # in even steps: frames are solved several at once
            send(bundle([encode(waiting.popleft())])[0])
            due = max(due + 1 / PRIOR_FPS, now + 0.5 / PRIOR_FPS)
        receiver.wait(max(0.0, due - now) if waiting else 1.0)
