"""A character that is steered live in a process of its own.

Neither a web server nor another character then delays its steps: each has its own core as long as there are cores.
Times cross between processes as values of time.perf_counter, which all processes of a machine share.
"""

import math
import multiprocessing
import queue
import re
import threading
from collections import deque
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from controllers.steering.process_worker import CharacterRequest, run_worker
from mapctl import curves
from mapctl.errors import MapctlError, RequestError
from mapctl.intent.steering import Arrival, Command
from mapctl.runtime.live_protocol import FrameChunk
from mapctl.runtime.processes import send_queued, spawn
from mapctl.skeleton import Skeleton

__all__ = ["CharacterProcess", "CharacterRequest"]

_READY_SECONDS = 120.0
_MAX_QUEUED_STEPS = 3000  # steps that are kept for a caller that does not poll: five minutes
_PROCESS_ENDED = "a character's process ended by itself"


class CharacterProcess:
    """A LiveCharacter (mapctl.runtime.live_protocol) in a process of its own."""

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
        """See LiveCharacter."""
        self._send("command", command)

    def walk(self, points: Sequence[tuple[float, float]], speed: float) -> None:
        """See LiveCharacter. RequestError where the points make no curve."""
        positions = np.array(points, dtype=np.float64).reshape(-1, 2)
        curves.through(positions)  # so that errors are raised here, not in the process
        self._send("walk", positions, speed)

    def aim(self, command: Command) -> None:
        """See LiveCharacter."""
        self._send("aim", command)

    def go(self, command: Command, place: tuple[float, float], within: float, facing: float | None = None) -> None:
        """See LiveCharacter. RequestError where the request has no `transitions`, and for numbers that are none."""
        if self._request.transitions is None:
            raise RequestError("this character was made without transitions, which take it to a place")
        Arrival(place, within, facing)  # so that errors are raised here, not in the process
        self._send("go", command, place, within, facing)

    def pause(self, paused: bool) -> None:
        """See LiveCharacter."""
        self._send("pause", paused)

    def reset(self) -> None:
        """See LiveCharacter. A process that has ended is started again, which takes a while."""
        if self._failed:
            self.close()
            self._start()
        else:
            self._send("reset")

    def poll(self) -> list[FrameChunk]:
        """See LiveCharacter."""
        failed, found = self._failed, list[FrameChunk]()  # in this order: frames before the end are kept
        while self._delivered:
            found.append(self._delivered.popleft())
        if failed and not found:
            raise MapctlError(failed)
        return found

    def memory_mb(self) -> float:
        """Return the resident memory of the process, MB; NaN where the system does not report it."""
        status = Path(f"/proc/{self._process.pid}/status")
        found = re.search(r"VmRSS:\s*(\d+) kB", status.read_text()) if status.exists() else None
        return int(found[1]) / 1024 if found else math.nan

    def close(self) -> None:
        """See LiveCharacter."""
        self._send("close")
        self._process.join(2.0 if self._ready.is_set() else 0.1)  # while it loads it does not listen yet
        if self._process.is_alive():
            self._process.kill()
            self._process.join()
        self._receiver.join(1.0)  # it reads to the end, which is now
        self._orders.put(None)
        self._ours.close()

    def _start(self) -> None:
        self._ours, worker_connection = multiprocessing.Pipe()
        self._process = spawn(run_worker, worker_connection, self._request)
        worker_connection.close()
        self._delivered: deque[FrameChunk] = deque(maxlen=_MAX_QUEUED_STEPS)
        self._orders: queue.SimpleQueue[tuple[Any, ...] | None] = queue.SimpleQueue()
        self._ready, self._failed = threading.Event(), ""
        # A full pipe would block the character, so it is emptied whether or not the caller polls; and a character that
        # does not read its orders does not block the caller.
        self._receiver = threading.Thread(target=self._receive, daemon=True)
        self._receiver.start()
        threading.Thread(target=send_queued, args=(self._ours, self._orders), daemon=True).start()

    def _send(self, *message: Any) -> None:
        self._orders.put(message)

    def _receive(self) -> None:
        try:
            while True:
                word, content = self._ours.recv()
                if word == "frames":
                    self._delivered.append(content)
                elif word == "failed":
                    self._failed = content
                self._ready.set()
        except (EOFError, OSError):
            self._failed = self._failed or _PROCESS_ENDED
            self._ready.set()
