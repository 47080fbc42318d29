"""Streams of poses and orders over OSC, for the commands that have them. The package python-osc is imported on use."""

import socket
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass
from importlib.util import find_spec
from typing import TYPE_CHECKING

from mapctl.commands.shared import options
from mapctl.errors import RequestError
from mapctl.skeleton import Skeleton
from mapctl.streaming.messages import LOOPBACK, Endpoint

if TYPE_CHECKING:
    from mapctl.streaming.receiver import OscReceiver
    from mapctl.streaming.sender import PoseStream

_STREAM, _LISTEN = "--stream", "--listen"
_MAX_DELAY = 5.0  # seconds
_PARSE_SECONDS = 0.05  # in which a relay reads packets: none is left out because the machine is busy


@dataclass(frozen=True, kw_only=True)
class StreamOptions:
    """Options on how poses are streamed."""

    stream: options.MaybeEndpoint = None
    """Where poses go over the VMC protocol, each frame when it is due (most programs receive at port 39539). A port
    alone is on this machine; a second character's poses go to the next port, and so on."""
    stream_root: bool = False
    """Let the root travel over the ground in the stream, and not the hips."""
    stream_delay: options.Number = 0.1
    """Seconds by which the stream is behind, so that a frame that is computed late is not sent late."""


def check(command: StreamOptions, listen: str | None = None, *, characters: int = 1) -> None:
    """Raise RequestError for options that cannot be, or not together."""
    if command.stream_root and command.stream is None:
        raise RequestError(f"--stream-root is an option of {_STREAM}; give both")
    if not 0 <= command.stream_delay <= _MAX_DELAY:
        raise RequestError(f"--stream-delay must be 0 to {_MAX_DELAY:g} seconds, got {command.stream_delay:g}")
    check_endpoints(command.stream, listen, characters=characters)


def check_endpoints(stream: str | None, listen: str | None, *, characters: int = 1) -> None:
    """Raise RequestError for endpoints that cannot be, unknown hosts, ports that meet, or a missing package."""
    if (stream or listen) and find_spec("pythonosc") is None:
        raise RequestError("streaming needs the package python-osc: pip install 'mapctl[stream]'")
    source = None if listen is None else Endpoint.parse(listen, option=_LISTEN)
    if stream is None:
        return
    first = Endpoint.parse(stream, option=_STREAM)
    last, (_, address) = first.offset(characters - 1, option=_STREAM), first.resolve(option=_STREAM)
    meet = source is not None and first.port <= source.port <= last.port
    if source and meet and address in (source.resolve(option=_LISTEN)[1], LOOPBACK, "::1"):
        raise RequestError(f"{_LISTEN} {source} is where {_STREAM} sends poses to; choose another port")


def open_stream(command: StreamOptions, skeletons: Sequence[Skeleton]) -> "PoseStream | None":
    """Open the stream of characters with these bones; None where none is requested."""
    if command.stream is None:
        return None
    from mapctl.streaming.sender import PoseStream

    to = Endpoint.parse(command.stream, option=_STREAM)
    return PoseStream(to, skeletons, root_travels=command.stream_root, delay=command.stream_delay)


@contextmanager
def open_relay(
    stream: str, listen: str, *, what: str, quiet: bool
) -> Iterator[tuple["OscReceiver", Callable[[bytes], None]]]:
    """Open a receiver, and what sends a packet on, until Ctrl-C; print `what` goes on, and what was not understood."""
    check_endpoints(stream, listen)
    from mapctl.streaming.receiver import OscReceiver

    target = Endpoint.parse(stream, option=_STREAM)
    family, address = target.resolve(option=_STREAM)
    receiver = OscReceiver(Endpoint.parse(listen, option=_LISTEN), parse_seconds=_PARSE_SECONDS)
    with closing(receiver), socket.socket(family, socket.SOCK_DGRAM) as out:

        def send(packet: bytes) -> None:
            with suppress(OSError):  # nobody receives, or there is no room: the next frame comes anyway
                out.sendto(packet, (address, target.port))

        if not quiet:
            print(f"poses of {receiver.endpoint} go to {target} {what}; Ctrl-C ends", flush=True)
        with suppress(KeyboardInterrupt):
            yield receiver, send
    if not quiet:
        print(f"\n{receiver.dropped} packets were not understood{receiver.fault and f' ({receiver.fault})'}")


def summarise(stream: "PoseStream") -> str:
    """Return what was sent, in a line."""
    sent = stream.statistics
    lost = f", {sent.not_sent} not sent ({sent.fault})" if sent.not_sent else ""
    return (
        f"stream    {sent.frames_sent} frames to {', '.join(map(str, stream.endpoints))}, {sent.late} late, "
        f"at most {sent.largest_lateness_ms:.1f} ms after they were due{lost}"
    )
