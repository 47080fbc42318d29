"""Streams of poses: frames become packets here, and `post` sends each when it is due."""

import multiprocessing
import queue
import threading
from collections.abc import Sequence
from contextlib import suppress

from jaxtyping import Float
from numpy import ndarray
from pythonosc.osc_bundle_builder import IMMEDIATELY, OscBundleBuilder
from pythonosc.osc_message import OscMessage
from pythonosc.osc_message_builder import OscMessageBuilder

from mapctl.features import PRIOR_FPS
from mapctl.runtime.processes import send_queued, spawn
from mapctl.skeleton import Skeleton
from mapctl.streaming import vmc
from mapctl.streaming.endpoint import Endpoint
from mapctl.streaming.messages import Message
from mapctl.streaming.post import StreamStatistics, run_post

LATE_SECONDS = 0.5 / PRIOR_FPS
"""A frame that is sent more than this after it was due is late: half the time for which it is shown."""
DEFAULT_DELAY = 0.1
"""Seconds by which the stream is behind: as late as steering lets frames be before it holds its time."""
OPTION = "--stream"
_MAX_BUNDLE_BYTES = 1200  # as VirtualMotionCapture itself: below what any network sends in one piece
_BUNDLE_HEAD, _LENGTH_HEAD = 16, 4  # bytes of a bundle before its first message, and before each
_MAX_QUEUED = 3000  # messages to a process that does not read: beyond them frames are lost
_END_SECONDS = 3.0


class PoseStream:
    """Frames of one or several characters, each sent to a port of its own: the endpoint's and those after it."""

    def __init__(
        self,
        endpoint: Endpoint,
        skeletons: Sequence[Skeleton],
        *,
        root_travels: bool = False,
        delay: float = DEFAULT_DELAY,
    ):
        """Start the process that sends. `skeletons` have the canonical joints; see `vmc.encode_frame` for
        `root_travels`.

        Every frame is sent `delay` seconds after it is to be seen here, so that one that is delivered late by less
        is sent in time. RequestError where the host is unknown, or there are not so many ports.
        """
        self.endpoints = [endpoint.offset(k, option=OPTION) for k in range(len(skeletons))]
        family, address = endpoint.resolve(option=OPTION)
        receivers = [(address, one.port) for one in self.endpoints]
        self._skeletons, self._root_travels, self._delay = list(skeletons), root_travels, delay
        self.statistics = StreamStatistics()
        """What was sent; known after `close`."""
        self._ours, theirs = multiprocessing.Pipe()
        self._process = spawn(run_post, theirs, int(family), receivers, LATE_SECONDS)
        theirs.close()
        self._queue: queue.SimpleQueue[tuple[object, ...] | None] = queue.SimpleQueue()
        threading.Thread(target=send_queued, args=(self._ours, self._queue), daemon=True).start()

    def put(
        self,
        character: int,
        due: float,
        seconds: float,
        root: Float[ndarray, "frames 3"],
        quats: Float[ndarray, "frames joints 4"],
    ) -> None:
        """Send frames of a character, at PRIOR_FPS, the first at `due` (a value of time.perf_counter); `seconds` is the
        stream's time of the first, `root` the hips in the world, metres, and `quats` local rotations, xyzw."""
        if self._queue.qsize() > _MAX_QUEUED:
            return
        skeleton = self._skeletons[character]
        for k in range(len(root)):
            at = k / PRIOR_FPS
            messages = vmc.encode_frame(skeleton, root[k], quats[k], seconds + at, root_travels=self._root_travels)
            self._queue.put(("put", character, due + at + self._delay, pack(messages)))

    def forget(self, character: int) -> None:
        """Send nothing of a character that has not been sent: it restarts."""
        self._queue.put(("forget", character))

    def pause(self) -> None:
        """Count the time until the next frames as a pause."""
        self._queue.put(("pause",))

    def close(self) -> None:
        """Send what still waits, each frame at its time, and end."""
        self._queue.put(("close",))
        self._queue.put(None)
        with suppress(OSError, EOFError):
            if self._ours.poll(self._delay + _END_SECONDS):
                self.statistics = self._ours.recv()
        self._process.join(0.5)
        if self._process.is_alive():
            self._process.kill()
            self._process.join()
        self._ours.close()


def pack(messages: Sequence[Message]) -> list[bytes]:
    """Pack messages into packets of at most 1200 bytes, OSC bundles, in order."""
    bundles, size = [OscBundleBuilder(IMMEDIATELY)], _BUNDLE_HEAD
    for message in map(_build, messages):
        if size + _LENGTH_HEAD + message.size > _MAX_BUNDLE_BYTES:
            bundles.append(OscBundleBuilder(IMMEDIATELY))
            size = _BUNDLE_HEAD
        bundles[-1].add_content(message)
        size += _LENGTH_HEAD + message.size
    return [bundle.build().dgram for bundle in bundles]


def _build(message: Message) -> OscMessage:
    builder = OscMessageBuilder(message.address)
    for argument in message.arguments:
        builder.add_arg(argument)  # pyright: ignore[reportArgumentType]
    return builder.build()
