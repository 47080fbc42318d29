"""Streams of poses and orders over OSC, for the commands that have them. The package python-osc is imported on use."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from typing import TYPE_CHECKING

from mapctl.errors import RequestError
from mapctl.skeleton import Skeleton
from mapctl.streaming.endpoint import Endpoint

if TYPE_CHECKING:
    from mapctl.streaming.receiver import OscReceiver
    from mapctl.streaming.sender import PoseStream

_STREAM, _LISTEN = "--stream", "--listen"
_MAX_DELAY = 5.0  # seconds


@dataclass(frozen=True)
class StreamOptions:
    """How poses are streamed."""

    to: str | None
    """Where they go, HOST:PORT; None streams nothing."""
    root_travels: bool
    """Whether the root travels, and not the hips."""
    delay: float
    """Seconds by which the stream is behind."""


def check(stream: StreamOptions, listen: str | None = None, *, characters: int = 1) -> None:
    """Raise RequestError for endpoints that cannot be, unknown hosts, ports that meet, or a missing package."""
    if stream.root_travels and stream.to is None:
        raise RequestError(f"--stream-root says how {_STREAM} is sent; give both")
    if not 0 <= stream.delay <= _MAX_DELAY:
        raise RequestError(f"--stream-delay must be 0 to {_MAX_DELAY:g} seconds, got {stream.delay:g}")
    targets: list[Endpoint] = []
    if stream.to is not None:
        first = Endpoint.parse(stream.to, option=_STREAM)
        targets = [first.offset(k, option=_STREAM) for k in range(characters)]
        first.resolve(option=_STREAM)
    if listen is not None:
        source = Endpoint.parse(listen, option=_LISTEN)
        if any(source == target for target in targets):
            raise RequestError(f"{_LISTEN} {source} is where {_STREAM} sends poses to; choose another port")
    if (stream.to or listen) and find_spec("pythonosc") is None:
        raise RequestError("streaming needs the package python-osc: pip install 'mapctl[stream]'")


def open_stream(stream: StreamOptions, skeletons: Sequence[Skeleton]) -> "PoseStream | None":
    """Open the stream of characters with these bones; None where none is asked for."""
    if stream.to is None:
        return None
    from mapctl.streaming.sender import PoseStream

    to = Endpoint.parse(stream.to, option=_STREAM)
    return PoseStream(to, skeletons, root_travels=stream.root_travels, delay=stream.delay)


def open_receiver(text: str | None) -> "OscReceiver | None":
    """Open the source of orders; None where none is asked for. RequestError where its port is taken."""
    if text is None:
        return None
    from mapctl.streaming.receiver import OscReceiver

    return OscReceiver(Endpoint.parse(text, option=_LISTEN))


def describe(stream: "PoseStream | None", receiver: "OscReceiver | None") -> Iterator[str]:
    """Yield a line each on where poses go and where orders come from."""
    if stream is not None:
        yield f"poses go to {', '.join(map(str, stream.endpoints))} (VMC)"
    if receiver is not None:
        yield f"orders come from {receiver.endpoint} (OSC)"


def summarise(stream: "PoseStream") -> str:
    """Return what was sent, in a line."""
    sent = stream.statistics
    lost = f", {sent.not_sent} not sent ({sent.fault})" if sent.not_sent else ""
    return (
        f"stream    {sent.frames_sent} frames to {', '.join(map(str, stream.endpoints))}, {sent.late} late, "
        f"at most {sent.largest_lateness_ms:.1f} ms after they were due, largest gap {sent.largest_gap_ms:.1f} ms{lost}"
    )
