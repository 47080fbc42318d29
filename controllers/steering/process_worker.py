"""The process of a character that is steered live: load, begin, and at every step read orders and send frames."""

import itertools
import os
import time
import traceback
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field, replace
from multiprocessing.connection import Connection
from typing import Any

import torch

from controllers.steering import steer
from controllers.steering.arrival import Arriver
from controllers.steering.autopilot import Autopilot
from controllers.steering.loop import find_second_zero, iterate_steps
from controllers.steering.steer import SteerFrames, SteerSettings
from mapctl import curves
from mapctl.errors import MapctlError
from mapctl.features import PRIOR_FPS
from mapctl.intent.steering import Arrival, Command
from mapctl.protocols import Density
from mapctl.runtime.live_protocol import FrameChunk
from mapctl.skeleton import CANONICAL, Skeleton

_WARM_UP_STEPS = 3  # steps before the clock starts, which compile and load what is needed
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
    """Loader of who makes the way to a place, called there too; without one the character can be sent nowhere."""


class ParentClosed(Exception):
    """The parent process closed the connection, or has ended."""


class ProcessClock:
    """Clock and Display of the character's process: it reads orders while it waits, and sends frames."""

    real = True

    def __init__(self, connection: Connection, pilot: Autopilot, prior: Density):
        self._connection, self._pilot, self._prior = connection, pilot, prior
        self.again = False
        self._began = 0.0  # time of the stream's second 0
        self._behind = 0.0  # seconds by which the clock is behind time.perf_counter: pauses, and what was held
        self._paused_at: float | None = None  # value of time.perf_counter
        self._held = 0.0  # seconds by which the next frames are late
        self._notes: list[str] = []

    def now(self) -> float:
        """See Clock: time.perf_counter less the pauses."""
        return (time.perf_counter() if self._paused_at is None else self._paused_at) - self._behind

    def wait_until(self, seconds: float) -> None:
        """See Clock."""
        while True:
            left = max(0.0, seconds - self.now()) if self._paused_at is None else None
            if self._connection.poll(left):
                self._handle_order()
            elif left is not None:
                return

    def hold(self, seconds: float) -> None:
        """See Clock: like a pause."""
        self._behind += seconds
        self._held += seconds

    def show(self, frames: SteerFrames, due: float) -> None:
        """See Display."""
        self._pilot.show(frames, due)
        if frames.refusal is not None:
            self._notes.append(frames.refusal.reason)
        at = self._began + due + self._behind
        spare = at - time.perf_counter() - self._held
        chunk = _to_frame_chunk(frames, due, at=at, spare=spare, notes=tuple(self._notes))
        self._connection.send(("frames", chunk))
        self._held = 0.0
        self._notes.clear()

    def begin(self, state: steer.SteerState, frames: SteerFrames) -> None:
        """Show the first pose, and start the stream's seconds there."""
        self.again = False
        self._began = find_second_zero(self, state)
        self.show(frames, 0.0)

    def _pause(self, paused: bool) -> None:
        now = time.perf_counter()
        if self._paused_at is not None:
            self._behind += now - self._paused_at
        self._paused_at = now if paused else None

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
            self.again = True
        elif word == "pause":
            self._pause(*content)
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
            _warm_up(state, first, transitions)
            connection.send(("ready", None))
        _wait_for_turn(request.settings.commit / PRIOR_FPS)
        clock.begin(state, pose)
        for _ in iterate_steps(state, pilot, [clock], clock=clock, stepper=stepper):
            if clock.again:
                break
        pilot.stay()
        first = pilot.at(clock.now())


def _wait_for_turn(seconds: float) -> None:
    """Wait until a moment that is this process's own among steps of so many seconds: characters that begin together
    would search at the same time and then rest at the same time, and the last would have hardly any time to spare."""
    turn = os.getpid() * _TURN % 1
    time.sleep(seconds * ((turn - time.perf_counter() / seconds) % 1))


def _warm_up(state: steer.SteerState, first: Command, transitions: Any | None) -> None:
    for _ in range(_WARM_UP_STEPS):
        steer.step(state, first)
    if transitions is not None:
        Arriver(transitions)(state, replace(first, arrival=Arrival((0.0, 0.0), 1.0)))


def _to_frame_chunk(
    frames: SteerFrames, seconds: float, *, at: float, spare: float, notes: tuple[str, ...]
) -> FrameChunk:
    return FrameChunk(
        at,
        seconds,
        frames.motion.root_position.numpy(),
        frames.motion.local_quat_xyzw.numpy(),
        frames.contacts.numpy(),
        frames.forecast.numpy(),
        frames.steering_targets[-1].velocity,
        spare,
        frames.seconds,
        notes,
    )
