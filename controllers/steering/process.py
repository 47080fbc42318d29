"""A character that is steered live in a process of its own: it reads orders at every step and sends frames.

Neither a web server nor another character then delays its steps: each has its own core as long as there are cores.
Times cross between processes as values of time.perf_counter, which all processes of a machine share. It obeys the last
command, or follows a drawn path by pure pursuit, for curves that are not known in advance; `controllers.follow` is more
exact.
"""

import itertools
import math
import multiprocessing
import os
import queue
import threading
import time
import traceback
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from multiprocessing.connection import Connection
from typing import Any

import numpy as np
import torch

from controllers.steering import steer
from controllers.steering.arrival import Arriver
from controllers.steering.loop import WallClock, find_second_zero, iterate_steps, make_chunk
from controllers.steering.steer import SteerFrames, SteerSettings
from mapctl import curves
from mapctl.curves.curve import Curve
from mapctl.errors import MapctlError, RequestError
from mapctl.features import PRIOR_FPS
from mapctl.intent.steering import Arrival, Command, SteeringLimits
from mapctl.protocols import Density
from mapctl.runtime.live_protocol import FrameChunk
from mapctl.runtime.processes import preload, send_queued, spawn
from mapctl.skeleton import CANONICAL, Skeleton

_ARRIVAL_DISTANCE = 0.15  # metres before the end of a path at which the character stops
_SEARCH_BACKWARD, _SEARCH_FORWARD = 0.1, 0.5  # metres around the last nearest arc in which the next is searched
_SEARCH_POINTS, _LOOK_AHEAD = 61, 0.5  # metres along the path to the point that is headed for


class Autopilot:
    """A source, `at`, and a display that takes the character's position, `show`."""

    def __init__(self, command: Command, limits: SteeringLimits):
        """Begin with a command; `limits` determine how soon to brake before the end of a path."""
        self._command, self._limits = command, limits
        self._path: Curve | None = None
        self._arc = 0.0  # of the path's point last nearest to the character, metres
        self._goal: Arrival | None = None  # its time counted from when it is requested
        self._position: torch.Tensor | None = None  # of the hips, x and z, metres

    def command(self, command: Command) -> None:
        """Hold this command from now on."""
        self._command, self._path, self._goal = command, None, None

    def go(self, command: Command, position: tuple[float, float], within: float, facing: float | None) -> None:
        """Be at a `position` (x, z, metres) `within` so many seconds from the next step, `facing` a heading (radians),
        and hold the command from then on."""
        self.command(command)
        self._goal = Arrival(position, within, facing)

    def stay(self) -> None:
        """Cancel the order to arrive."""
        self._command, self._goal = replace(self._command, arrival=None), None

    def aim(self, command: Command) -> None:
        """Reach, look and walk round obstacles as this command does; nothing else of it counts."""
        self._command = replace(
            self._command, reach=command.reach, look_at=command.look_at, obstacles=command.obstacles
        )

    def walk(self, curve: Curve, speed: float) -> None:
        """Walk along a curve at a `speed` in m/s, with the step length and labels of the last command; stop at the end
        of an open one."""
        self._path, self._arc, self._goal = curve, 0.0, None
        self._command = replace(self._command, speed=speed, arrival=None)

    def show(self, frames: SteerFrames, due: float) -> None:
        """Keep where the character is; when its frames are `due` (seconds of the stream) does not matter."""
        self._position = frames.motion.root_position[-1, ::2]

    def at(self, seconds: float) -> Command:
        """Return the command that holds now, at so many seconds of the stream; on a path that towards a point ahead."""
        if self._goal is not None:
            self._command = replace(self._command, arrival=replace(self._goal, by=seconds + self._goal.by))
            self._goal = None
        if self._path is None:
            return self._command
        path, here = self._path, self._position if self._position is not None else self._path.ground_point(0.0)
        first, last = self._arc - _SEARCH_BACKWARD, self._arc + _SEARCH_FORWARD
        arcs = torch.linspace(first, last, _SEARCH_POINTS, dtype=torch.float64)
        self._arc = float(arcs[(path.ground_point(arcs) - here).norm(dim=-1).argmin()])
        heading = math.atan2(*(path.ground_point(self._arc + _LOOK_AHEAD) - here).tolist())
        led = replace(self._command, heading=heading, facing=None, turning=None)
        if path.closed:
            return led
        left = path.length - self._arc - _ARRIVAL_DISTANCE
        if left <= 0:
            self.command(replace(led, speed=0.0, step_length=None))
            return self._command
        # The highest speed from which braking stops in time: v^2 = 2 a s.
        return replace(led, speed=min(led.speed, math.sqrt(2 * self._limits.braking * left)))


_TURN = 0.618034  # share of a step between processes one after the other: multiples of the golden ratio spread evenly


@dataclass(frozen=True)
class CharacterRequest:
    """Request for a steered character."""

    load: Callable[[], Any]
    """Loader of the density, called in the character's process: `functools.partial(priors.load, "locomotion")`."""
    first: Command
    """First command."""
    seed: int = 0
    """Seed of the first pose."""
    at: tuple[float, float] = (0.0, 0.0)
    """Position of the first pose, x and z in metres."""
    settings: SteerSettings = field(default_factory=SteerSettings)
    """Sigmas, window lengths and budget."""
    skeleton: Skeleton = CANONICAL
    """Bones of the character, on canonical joints; the toes' height of its stance is that of the settings' footing."""
    transitions: Callable[[], Any] | None = None
    """Loader of the model of arrivals, called there too; without one the character cannot be sent to a position."""


class ParentClosed(Exception):
    """The parent process closed the connection, or has ended."""


class ProcessClock(WallClock):
    """Clock of the character's process: reads orders while it waits; its display `show` sends frames."""

    def __init__(self, connection: Connection, pilot: Autopilot, prior: Density):
        self._connection, self._pilot, self._prior = connection, pilot, prior
        self.restart = False
        self._began = 0.0  # time of the stream's second 0
        self._behind = 0.0  # seconds by which the clock is behind time.perf_counter: pauses, and what was held
        self._paused_at: float | None = None  # value of time.perf_counter
        self._held = 0.0  # seconds by which the next frames are late
        self._notes: list[str] = []

    def now(self) -> float:
        """Return time.perf_counter less the pauses, seconds."""
        return (time.perf_counter() if self._paused_at is None else self._paused_at) - self._behind

    def wait_until(self, seconds: float) -> None:
        """Obey orders until that time, seconds."""
        while True:
            left = max(0.0, seconds - self.now()) if self._paused_at is None else None
            if self._connection.poll(left):
                self._handle_order()
            elif left is not None:
                return

    def hold(self, seconds: float) -> None:
        """Pause for so many seconds."""
        self._behind += seconds
        self._held += seconds

    def show(self, frames: SteerFrames, due: float) -> None:
        """Send the frames; `due` is in seconds of the stream."""
        self._pilot.show(frames, due)
        if frames.refusal is not None:
            self._notes.append(frames.refusal.reason)
        at = self._began + due + self._behind
        spare = at - time.perf_counter() - self._held
        chunk = make_chunk(frames, at, due, spare=spare, notes=tuple(self._notes))
        self._connection.send(("frames", chunk))
        self._held = 0.0
        self._notes.clear()

    def begin(self, state: steer.SteerState, frames: SteerFrames) -> None:
        """Show the first pose, and start the stream's seconds there."""
        self.restart = False
        self._began = find_second_zero(self, state)
        self.show(frames, 0.0)

    def _handle_order(self) -> None:
        try:
            word, *content = self._connection.recv()
        except EOFError:
            raise ParentClosed from None
        if word == "close":
            raise ParentClosed
        try:
            self._execute_order(word, *content)
        except MapctlError as error:  # an impossible order; the one before it holds
            self._notes.append(str(error))

    def _execute_order(self, word: str, *content: Any) -> None:
        if word == "reset":
            self.restart = True
        elif word == "pause":
            (paused,), now = content, time.perf_counter()
            if self._paused_at is not None:
                self._behind += now - self._paused_at
            self._paused_at = now if paused else None
        elif word == "aim":
            self._pilot.aim(*content)
        elif word == "go":
            command, *where = content
            command, notes = steer.accept(self._prior, command)
            self._notes += notes
            self._pilot.go(command, *where)
        elif word == "walk":
            points, speed, closed = content
            self._pilot.walk(curves.through(points, closed=closed), min(speed, self._prior.limits.max_steering_speed))
        else:
            command, notes = steer.accept(self._prior, *content)
            self._notes += notes
            self._pilot.command(command)


def run_worker(connection: Connection, request: CharacterRequest) -> None:
    """Steer until the parent closes the connection; anything else that ends it is sent to the parent, in a line."""
    torch.set_num_threads(1)
    with suppress(ParentClosed, BrokenPipeError):
        try:
            connection.send(("started", os.getpid()))
            _run_character(connection, request)
        except ParentClosed:  # a requested end is no failure to report
            return
        except MapctlError as error:
            connection.send(("failed", str(error)))
        except Exception as error:
            last = traceback.extract_tb(error.__traceback__)[-1]
            what = f"{type(error).__name__}: {error}".splitlines()[0]
            connection.send(("failed", f"a character's process ended: {what} ({last.name}, line {last.lineno})"))


def _run_character(connection: Connection, request: CharacterRequest) -> None:
    prior, transitions = request.load(), None if request.transitions is None else request.transitions()
    first, generator = steer.accept(prior, request.first)[0], torch.Generator().manual_seed(request.seed)
    pilot = Autopilot(first, request.settings.limits)
    stepper = steer.step if transitions is None else Arriver(transitions)
    clock = ProcessClock(connection, pilot, prior)
    for number in itertools.count():
        state, pose = steer.begin(
            prior, first, generator=generator, at=request.at, settings=request.settings, skeleton=request.skeleton
        )
        if number == 0:
            arrival = None if transitions is None else Arrival(request.at, 1.0)
            steer.warm_up(state, [first, replace(first, arrival=arrival)], stepper=stepper)
            connection.send(("ready", None))
        _wait_for_turn(request.settings.commit / PRIOR_FPS)
        clock.begin(state, pose)
        for _ in iterate_steps(state, pilot.at, [clock.show], clock=clock, stepper=stepper):
            if clock.restart:
                break
        pilot.stay()
        first = pilot.at(clock.now())


def _wait_for_turn(seconds: float) -> None:
    """Wait until a moment that is this process's own among steps of so many seconds: characters that begin together
    would search at the same time and then rest at the same time, and the last would have hardly any time to spare."""
    turn = os.getpid() * _TURN % 1
    time.sleep(seconds * ((turn - time.perf_counter() / seconds) % 1))


_READY_SECONDS = 120.0
_MAX_QUEUED_STEPS = 3000  # steps that are kept for a caller that does not poll: five minutes
_PROCESS_ENDED = "a character's process ended by itself"

preload("controllers.steering.process")


class CharacterProcess:
    """A live character in a process of its own; no order waits. RequestError for points that make no curve, for a
    position without `transitions` in the request, and for numbers that are not finite. A reset of a process that has
    ended starts it again, which takes a while."""

    def __init__(self, request: CharacterRequest):
        """Start the process; several start in parallel if all are created before the first `wait`."""
        self._request = request
        self.skeleton = request.skeleton
        self._start()

    def wait(self) -> None:
        """Wait until it walks. RequestError where its prior cannot be loaded, or does not have its labels."""
        if not self._ready.wait(_READY_SECONDS):
            self._failed = self._failed or "a character's process did not start"
        if self._failed:
            self.close()
            raise RequestError(self._failed)

    def command(self, command: Command) -> None:
        """Obey this command from now on, as far as possible (see `FrameChunk.notes`), and follow no path."""
        self._send("command", command)

    def walk(self, points: Sequence[tuple[float, float]], speed: float, *, closed: bool = False) -> None:
        """Walk along a smooth curve through two or more points (x and z, metres) at a speed in m/s, then stand; on and
        on along a closed one."""
        positions = np.array(points, dtype=np.float64).reshape(-1, 2)
        curves.through(positions, closed=closed)  # so that errors are raised here, not in the process
        self._send("walk", positions, speed, closed)

    def aim(self, command: Command) -> None:
        """Reach, look and walk round obstacles as in this command; nothing else of it counts, and a path is kept."""
        self._send("aim", command)

    def go(self, command: Command, position: tuple[float, float], within: float, facing: float | None = None) -> None:
        """Be at a position (x and z, metres) in so many seconds, facing so (radians; None as it comes there), if that
        is possible, and obey the command from then on; a note gives the reason if not."""
        if self._request.transitions is None:
            raise RequestError("this character has no transitions, which take it to a position")
        Arrival(position, within, facing)  # so that errors are raised here, not in the process
        self._send("go", command, position, within, facing)

    def pause(self, paused: bool) -> None:
        """Stop the clock, or let it go on."""
        self._send("pause", paused)

    def reset(self) -> None:
        """Restart from the initial pose; also a character that has ended."""
        if self._failed:
            self.close()
            self._start()
        else:
            self._send("reset")

    def poll(self) -> list[FrameChunk]:
        """Return what was delivered since the last call, oldest first. MapctlError if the character has ended."""
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
        self._ours, theirs = multiprocessing.Pipe()
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
