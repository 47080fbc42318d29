"""A character that is steered live in a process of its own.

Neither a web server nor another character then delays its steps: each has its own core as long as there are cores.
Times cross between processes as values of time.perf_counter, which all processes of a machine share.
"""

import queue
import threading
from collections import deque
from collections.abc import Sequence
from typing import Any

import numpy as np

from controllers.steering.process_worker import CharacterRequest, run_worker
from mapctl import curves
from mapctl.errors import MapctlError, RequestError
from mapctl.intent.steering import Arrival, Command
from mapctl.runtime.live_protocol import FrameChunk
from mapctl.runtime.processes import open_pipe, preload, send_queued, spawn
from mapctl.skeleton import Skeleton

__all__ = ["CharacterProcess", "CharacterRequest"]

_READY_SECONDS = 120.0
_MAX_QUEUED_STEPS = 3000  # steps that are kept for a caller that does not poll: five minutes
_PROCESS_ENDED = "a character's process ended by itself"

preload("controllers.steering.process_worker")


class CharacterProcess:
    """A character that moves by itself in real time, in a process of its own, and takes orders at any moment: a
    LiveCharacter (mapctl.runtime.live_protocol). No order waits."""

    def __init__(self, request: CharacterRequest):
        """Start the process; several start in parallel if all are made before the first `wait`."""
        self._request = request
        self.skeleton: Skeleton = request.skeleton
        self._start()

    def wait(self) -> None:
        """Wait until it walks. RequestError where its prior cannot be loaded, or does not know its labels."""
        if not self._ready.wait(_READY_SECONDS):
            self._failed = self._failed or "a character's process did not start"
        if self._failed:
            self.close()
            raise RequestError(self._failed)

    def command(self, command: Command) -> None:
        """Obey this command from now on, as far as possible (`FrameChunk.notes` tell), and follow no path."""
        self._send("command", command)

    def walk(self, points: Sequence[tuple[float, float]], speed: float, *, closed: bool = False) -> None:
        """Walk along a smooth curve through two or more `points` (x and z, metres) at a `speed` in m/s, then stand; on
        and on along a closed one. RequestError where the points make no curve."""
        positions = np.array(points, dtype=np.float64).reshape(-1, 2)
        curves.through(positions, closed=closed)  # so that errors are raised here, not in the process
        self._send("walk", positions, speed, closed)

    def aim(self, command: Command) -> None:
        """Reach, look and walk round obstacles as this command says; nothing else of it counts, and a path is kept."""
        self._send("aim", command)

    def go(self, command: Command, place: tuple[float, float], within: float, facing: float | None = None) -> None:
        """Be at a `place` (x and z, metres) `within` so many seconds, `facing` so (radians; None as it comes there), if
        that is possible, and obey the command from then on; a note says why not. RequestError where the request has no
        `transitions`, and for numbers that are none."""
        if self._request.transitions is None:
            raise RequestError("this character was made without transitions, which take it to a place")
        Arrival(place, within, facing)  # so that errors are raised here, not in the process
        self._send("go", command, place, within, facing)

    def pause(self, paused: bool) -> None:
        """Stop the clock, or let it go on."""
        self._send("pause", paused)

    def reset(self) -> None:
        """Restart from the initial pose. A process that has ended is started again, which takes a while."""
        if self._failed:
            self.close()
            self._start()
        else:
            self._send("reset")

    def poll(self) -> list[FrameChunk]:
        """Return what was delivered since the last call, oldest first; never wait. MapctlError, after the last frame,
        if the character has ended."""
        failed, found = self._failed, list[FrameChunk]()  # in this order: frames before the end are kept
        while self._delivered:
            found.append(self._delivered.popleft())
        if failed and not found:
            raise MapctlError(failed)
        return found

    @property
    def pid(self) -> int | None:
        """Id of the process, a number of the operating system; None where there is none yet."""
        return self._process.pid

    def __enter__(self) -> "CharacterProcess":
        """Return it; it is closed at the end of a with block."""
        return self

    def __exit__(self, *error: object) -> None:
        """Close it."""
        self.close()

    def close(self) -> None:
        """End the character; harmless the second time."""
        self._send("close")
        self._process.join(2.0 if self._ready.is_set() else 0.1)  # while it loads it does not listen yet
        if self._process.is_alive():
            self._process.kill()
        self._orders.put(None)
        self._receiver.join(1.0)  # it reads to the end, which is now
        self._ours.close()

    def _start(self) -> None:
        self._delivered: deque[FrameChunk] = deque(maxlen=_MAX_QUEUED_STEPS)
        self._orders: queue.SimpleQueue[tuple[Any, ...] | None] = queue.SimpleQueue()
        self._ready, self._failed = threading.Event(), ""
        self._ours, theirs = open_pipe()
        with theirs:
            self._process = spawn(run_worker, theirs, self._request)
        # A full pipe would block the character, so it is emptied whether or not the caller polls; and a character that
        # does not read its orders does not block the caller.
        self._receiver = threading.Thread(target=self._receive, daemon=True)
        self._receiver.start()

    def _send(self, *message: Any) -> None:
        self._orders.put(message)

    def _receive(self) -> None:
        try:
            while True:
                word, content = self._ours.recv()
                if word == "started":
                    threading.Thread(target=send_queued, args=(self._ours, self._orders), daemon=True).start()
                    continue
                if word == "frames":
                    self._delivered.append(content)
                elif word == "failed":
                    self._failed = content
                self._ready.set()
        except (EOFError, OSError):
            self._failed = self._failed or _PROCESS_ENDED
            self._ready.set()
