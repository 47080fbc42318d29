"""Sending of packets at the moment at which they are due, in a process of its own that imports nothing heavy.

A thread beside a solver would wait for Python's lock, and on a busy machine for whoever holds it: 22 ms were measured.
"""

import heapq
import itertools
import socket
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from multiprocessing.connection import Connection
from typing import Any


@dataclass(frozen=True)
class StreamStatistics:
    """Messages sent, of all characters."""

    frames_sent: int = 0
    late: int = 0
    """Frames sent later after they were due than a frame may be."""
    largest_lateness_ms: float = 0.0
    """Largest time from when a frame was due to when it was sent, milliseconds."""
    not_sent: int = 0
    """Frames that the system would not send."""
    fault: str = ""
    """Why the first of those was not sent."""


class _Post:
    def __init__(self, family: int, receivers: Sequence[tuple[str, int]], late_seconds: float):
        self._receivers, self._late_seconds = receivers, late_seconds
        self._socket = socket.socket(family, socket.SOCK_DGRAM)
        self._socket.setblocking(False)
        self._waiting: list[tuple[float, int, int, Sequence[bytes]]] = []
        self._counter = itertools.count()
        self.statistics = StreamStatistics()

    def seconds_left(self) -> float | None:
        """Return the time until the next frame is due; None if none waits."""
        return max(0.0, self._waiting[0][0] - time.perf_counter()) if self._waiting else None

    def put(self, character: int, due: float, packets: Sequence[bytes]) -> None:
        heapq.heappush(self._waiting, (due, next(self._counter), character, packets))

    def forget(self, character: int) -> None:
        self._waiting = [frame for frame in self._waiting if frame[2] != character]
        heapq.heapify(self._waiting)

    def send_due(self) -> None:
        """Send what is due now."""
        while self._waiting and self._waiting[0][0] <= time.perf_counter():
            due, _, character, packets = heapq.heappop(self._waiting)
            try:
                for packet in packets:
                    self._socket.sendto(packet, self._receivers[character])
            except OSError as error:  # nobody there, or no room: the next frame comes anyway
                known, why = self.statistics, error.strerror or str(error)
                self.statistics = replace(known, not_sent=known.not_sent + 1, fault=known.fault or why)
            else:
                self._count_sent(time.perf_counter() - due)

    def _count_sent(self, lateness: float) -> None:
        known = self.statistics
        self.statistics = replace(
            known,
            frames_sent=known.frames_sent + 1,
            late=known.late + (lateness > self._late_seconds),
            largest_lateness_ms=max(known.largest_lateness_ms, 1000 * lateness),
        )


def run_post(connection: Connection, family: int, receivers: Sequence[tuple[str, int]], late_seconds: float) -> None:
    """Send frames, of each character to its receiver (numeric address and port), until the order to close, or until the
    parent has ended; then send what waits, and the statistics. A frame is late so many seconds after it was due."""
    post, listening = _Post(family, receivers, late_seconds), True
    while listening or post.seconds_left() is not None:
        if not listening:
            time.sleep(post.seconds_left() or 0.0)
        elif connection.poll(post.seconds_left()):
            listening = _obey(post, connection)
        post.send_due()
    try:
        connection.send(post.statistics)
    except OSError:  # nobody asks any more
        return


def _obey(post: _Post, connection: Connection) -> bool:
    """Take one message; return whether there will be more."""
    try:
        word, *content = connection.recv()
    except EOFError:
        return False
    actions: dict[str, Any] = {"put": post.put, "forget": post.forget}
    if word in actions:
        actions[word](*content)
    return word != "close"
