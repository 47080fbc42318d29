"""`mapctl smooth`: poses of a tracker are smoothed on their way to a viewer, over the VMC protocol."""

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated

from tyro.conf import arg

from mapctl.commands.shared import options, streaming
from mapctl.commands.shared.command import Command
from mapctl.errors import RequestError

if TYPE_CHECKING:
    from mapctl.streaming.receiver import OscReceiver
    from mapctl.streaming.relay import PoseRelay

_MAX_DELAY = 1.0  # seconds
_MIN_DELAY = 0.05
_FPS = 60


@dataclass(frozen=True)
class Smooth(Command):
    """Smooth a tracker's poses live, between tracker and viewer, over the VMC protocol; Ctrl-C ends."""

    stream: Annotated[str, arg(metavar="HOST:PORT")]
    """Where the poses go, 60 times a second: the port at which the viewer receives. A port alone is on this machine."""
    listen: Annotated[str, arg(metavar="HOST:PORT")] = "39539"
    """Where the tracker sends its poses: a port alone takes those of this machine; 0.0.0.0:PORT takes those of every
    machine."""
    delay: options.Number = 0.15
    """Seconds by which the poses are behind, 0.05 to 1: what comes within them decides what is noise."""
    quiet: options.Quiet = False


def run(command: Smooth) -> int:
    """Check, relay until Ctrl-C, and print what came and went."""
    if not _MIN_DELAY <= command.delay <= _MAX_DELAY:
        raise RequestError(f"--delay must be {_MIN_DELAY:g} to {_MAX_DELAY:g} seconds, got {command.delay:g}")
    what = f"(VMC), {command.delay:g} s later"
    with streaming.open_relay(command.stream, command.listen, what=what, quiet=command.quiet) as (receiver, send):
        from mapctl.streaming.relay import PoseRelay

        _relay(PoseRelay(command.delay), receiver, send)
    return 0


def _relay(relay: "PoseRelay", receiver: "OscReceiver", send: Callable[[bytes], None]) -> None:
    began, frame, due = time.perf_counter(), 0, 0.0
    while True:
        now = time.perf_counter() - began
        packets, is_due = relay.take(receiver.poll(), now), now >= due
        if is_due:
            packets += relay.frame(now)
            frame, due = frame + 1, max(due + 1 / _FPS, now)
        for packet in packets:
            send(packet)
        if is_due:
            relay.smoother.smooth()
        receiver.wait(max(0.0, due + began - time.perf_counter()))
