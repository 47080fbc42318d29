"""A character that is steered live in a process of its own.

Neither a web server nor another character then holds up its steps: each has its own core as long as there are cores.
Times cross between processes as values of time.perf_counter, which all processes of a machine share.
"""

import itertools
import math
import multiprocessing
import re
import signal
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np
import torch

from controllers import steer
from controllers.loop import steps
from controllers.pilot import Pilot
from controllers.steer import SteerFrames, SteerSettings
from mapctl import curves
from mapctl.errors import MapctlError, RequestError
from mapctl.features import PRIOR_FPS
from mapctl.skeleton import CANONICAL, Skeleton
from mapctl.steering import Command
from mapctl.streaming import Delivered

_WARM_UP = 3  # steps before the clock starts, in which what is loaded on first use is loaded
_READY_SECONDS = 120.0
_MOST_WAITING = 3000  # steps that are kept for somebody who does not look: five minutes
_GONE = "a character's process ended by itself"


@dataclass(frozen=True)
class RemoteRequest:
    """Who is to be steered."""

    load: Callable[[], Any]
    """Makes the density, in the character's process: `functools.partial(priors.load, "locomotion")`."""
    first: Command
    """To begin with."""
    seed: int = 0
    """Of the pose that it begins with."""
    at: tuple[float, float] = (0.0, 0.0)
    """Where it begins, x and z in metres."""
    settings: SteerSettings = field(default_factory=SteerSettings)
    """Sigmas, lengths and effort."""


class Remote:
    """A LiveCharacter (mapctl.streaming) in a process of its own."""

    skeleton: Skeleton = CANONICAL

    def __init__(self, request: RemoteRequest):
        """Start it; several start at once if all are made before the first is waited for."""
        context = multiprocessing.get_context("spawn")
        self._ours, theirs = context.Pipe()
        self._process = context.Process(target=_work, args=(theirs, request), daemon=True)
        self._process.start()
        theirs.close()
        self._delivered: deque[Delivered] = deque(maxlen=_MOST_WAITING)
        self._ready, self._failed = threading.Event(), ""
        # A full pipe would hold up the character, so it is emptied whether or not somebody looks.
        threading.Thread(target=self._receive, daemon=True).start()

    def wait(self) -> None:
        """Until it walks. RequestError where its prior cannot be loaded, or does not know what it is told."""
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
        places = np.array(points, dtype=np.float64).reshape(-1, 2)
        curves.through(places)  # what is wrong with them is said here, not there
        self._send("walk", places, speed)

    def pause(self, paused: bool) -> None:
        """See LiveCharacter."""
        self._send("pause", paused)

    def reset(self) -> None:
        """See LiveCharacter."""
        self._send("reset")

    def poll(self) -> list[Delivered]:
        """See LiveCharacter."""
        if self._failed:
            raise MapctlError(self._failed)
        found: list[Delivered] = []
        while self._delivered:
            found.append(self._delivered.popleft())
        return found

    def memory_mb(self) -> float:
        """Of its process, resident; NaN where the system does not tell."""
        status = Path(f"/proc/{self._process.pid}/status")
        found = re.search(r"VmRSS:\s*(\d+) kB", status.read_text()) if status.exists() else None
        return int(found[1]) / 1024 if found else math.nan

    def close(self) -> None:
        """See LiveCharacter."""
        with suppress(OSError):
            self._ours.send(("close",))
        self._process.join(2.0)
        if self._process.is_alive():
            self._process.terminate()
            self._process.join()
        self._ours.close()

    def _send(self, *message: Any) -> None:
        try:
            self._ours.send(message)
        except OSError as error:
            raise MapctlError(_GONE) from error

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
            self._failed = self._failed or _GONE
            self._ready.set()


class _Closed(Exception):
    """The other side wants the end, or is gone."""


class _Desk:
    """Clock and Display of the character's process: it reads orders while it waits, and sends frames."""

    real = True

    def __init__(self, connection: Connection, pilot: Pilot):
        self._connection, self._pilot = connection, pilot
        self.again = False
        self._began = 0.0  # when the stream's second 0 is
        self._paused_since: float | None = None
        self._shift = 0.0

    def now(self) -> float:
        """See Clock: time.perf_counter less the pauses."""
        return time.perf_counter() - self._shift

    def wait_until(self, seconds: float) -> None:
        """See Clock."""
        while True:
            left = None if self._paused_since is not None else max(0.0, seconds - self.now())
            if self._connection.poll(left):
                self._obey()
            elif left is not None:
                return

    def show(self, frames: SteerFrames, due: float) -> None:
        """See Display."""
        self._pilot.show(frames, due)
        self._connection.send(("frames", _plain(frames, due, self._began + due + self._shift)))

    def begin(self, state: steer.SteerState, frames: SteerFrames) -> None:
        """Show the first pose, from which on the stream's seconds count."""
        self.again = False
        lead = state.settings.commit / PRIOR_FPS
        self._began = self.now() - state.frames / PRIOR_FPS + lead  # as controllers.loop.steps has it
        self.show(frames, 0.0)

    def _obey(self) -> None:
        try:
            word, *content = self._connection.recv()
        except EOFError:
            raise _Closed from None
        if word == "close":
            raise _Closed
        if word == "reset":
            self.again = True
        elif word == "pause":
            self._pause(*content)
        elif word == "walk":
            self._pilot.walk(curves.through(content[0]), content[1])
        else:
            self._pilot.command(*content)

    def _pause(self, paused: bool) -> None:
        if paused and self._paused_since is None:
            self._paused_since = time.perf_counter()
        elif not paused and self._paused_since is not None:
            self._shift += time.perf_counter() - self._paused_since
            self._paused_since = None


def _work(connection: Connection, request: RemoteRequest) -> None:
    """What the character's process does."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the one who started this
    torch.set_num_threads(1)
    try:
        _steer(connection, request)
    except (_Closed, BrokenPipeError):
        return
    except MapctlError as error:
        with suppress(OSError):
            connection.send(("failed", str(error)))


def _steer(connection: Connection, request: RemoteRequest) -> None:
    prior, generator = request.load(), torch.Generator().manual_seed(request.seed)
    pilot = Pilot(request.first, request.settings.limits)
    desk = _Desk(connection, pilot)
    first = request.first
    for number in itertools.count():
        state, pose = steer.begin(prior, first, generator=generator, at=request.at, settings=request.settings)
        if number == 0:
            for _ in range(_WARM_UP):
                steer.step(state, first)
            connection.send(("ready", None))
        desk.begin(state, pose)
        for _ in steps(state, pilot, [desk], clock=desk):
            if desk.again:
                break
        first = pilot.at(desk.now())


def _plain(frames: SteerFrames, seconds: float, due: float) -> Delivered:
    energies = {entry.name: float(entry.energy.mean()) for entry in frames.ledger.entries}
    return Delivered(
        due, seconds, frames.motion.root_position.numpy(), frames.motion.local_quat_xyzw.numpy(),
        frames.contacts.numpy(), frames.forecast.numpy(), frames.wishes[-1].velocity, energies,
        due - time.perf_counter(), frames.seconds, frames.evaluations,
    )  # fmt: skip
