"""Links of a script that is played against the clock to other programs: poses go out, orders come in."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from controllers.steering.loop import Clock, Display, WallClock, find_second_zero
from controllers.steering.steer import SteerFrames, SteerState
from mapctl.commands.steer.remote import RemoteScript

if TYPE_CHECKING:
    from mapctl.streaming.receiver import OscReceiver
    from mapctl.streaming.sender import PoseStream


@dataclass(frozen=True)
class Links:
    """What is open."""

    stream: "PoseStream | None"
    """Where poses go."""
    receiver: "OscReceiver | None"
    """Where orders come from."""
    script: RemoteScript | None
    """The script as orders change it."""

    def displays(self, clock: Clock, state: SteerState, pose: SteerFrames, *, frames: int) -> Sequence[Display]:
        """Send the first pose, and return who shows the frames of a script of so many; the loop begins now."""
        shown: list[Display] = [] if self.script is None else [self.script]
        if self.stream is not None and isinstance(clock, WallClock):
            display = StreamDisplay(self.stream, clock, frames, find_second_zero(clock, state))
            display.show(pose, 0.0)
            shown.append(display)
        return shown

    def close(self) -> None:
        """Send what still waits, and end."""
        if self.receiver is not None:
            self.receiver.close()
        if self.stream is not None:
            self.stream.close()


@dataclass(frozen=True)
class StreamDisplay:
    """A Display that has frames sent when they are due."""

    stream: "PoseStream"
    """Where they go."""
    clock: WallClock
    """Clock of the loop."""
    frames: int
    """Frames that the script has; later ones are not sent."""
    zero: float
    """The clock's time at the stream's second 0."""

    def show(self, frames: SteerFrames, due: float) -> None:
        """See Display."""
        left = self.frames - round(due * float(frames.motion.fps))
        if left > 0:
            root, quats = frames.motion.root_position[:left], frames.motion.local_quat_xyzw[:left]
            self.stream.put(0, self.clock.perf_counter_at(self.zero + due), due, root.numpy(), quats.numpy())
