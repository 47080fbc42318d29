"""What the process of a character that is steered live does: load, begin; at every step read orders and send frames."""

import itertools
import time
import traceback
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from typing import Any

import torch

from controllers.steering import steer
from controllers.steering.autopilot import Autopilot
from controllers.steering.loop import iterate_steps
from controllers.steering.steer import SteerFrames, SteerSettings
from mapctl import curves
from mapctl.errors import MapctlError
from mapctl.features import PRIOR_FPS
from mapctl.intent.steering import Command
from mapctl.protocols import Density
from mapctl.runtime.live_protocol import FrameChunk

_WARM_UP_STEPS = 3  # steps before the clock starts, in which what is loaded on first use is loaded


@dataclass(frozen=True)
class CharacterRequest:
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


class ParentClosed(Exception):
    """The other side wants the end, or is gone."""


class ProcessClock:
    """Clock and Display of the character's process: it reads orders while it waits, and sends frames."""

    real = True

    def __init__(self, connection: Connection, pilot: Autopilot, prior: Density):
        self._connection, self._pilot, self._prior = connection, pilot, prior
        self.again = False
        self._began = 0.0  # when the stream's second 0 is
        self._paused_since: float | None = None
        self._shift = 0.0
        self._held = 0.0  # seconds by which the frames that are shown next came too late
        self._notes: list[str] = []

    def now(self) -> float:
        """See Clock: time.perf_counter less the pauses."""
        return time.perf_counter() - self._shift

    def wait_until(self, seconds: float) -> None:
        """See Clock."""
        while True:
            left = None if self._paused_since is not None else max(0.0, seconds - self.now())
            if self._connection.poll(left):
                self._handle_order()
            elif left is not None:
                return

    def hold(self, seconds: float) -> None:
        """See Clock: as a pause that nobody asked for."""
        self._shift += seconds
        self._held += seconds

    def show(self, frames: SteerFrames, due: float) -> None:
        """See Display."""
        self._pilot.show(frames, due)
        at = self._began + due + self._shift
        spare = at - time.perf_counter() - self._held
        self._connection.send(("frames", _to_frame_chunk(frames, due, at=at, spare=spare, notes=tuple(self._notes))))
        self._held = 0.0
        self._notes.clear()

    def begin(self, state: steer.SteerState, frames: SteerFrames) -> None:
        """Show the first pose, from which on the stream's seconds count."""
        self.again = False
        lead = state.settings.commit / PRIOR_FPS
        self._began = self.now() - state.frames / PRIOR_FPS + lead  # as controllers.steering.loop.iterate_steps has it
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
        except MapctlError as error:  # an order that cannot be; the one before it holds
            self._notes.append(str(error))

    def _execute_order(self, word: str, *content: Any) -> None:
        if word == "reset":
            self.again = True
        elif word == "pause":
            self._pause(*content)
        elif word == "walk":
            points, speed = content
            self._pilot.walk(curves.through(points), min(speed, self._prior.limits.max_steering_speed))
        else:
            command, notes = steer.accept(self._prior, *content)
            self._notes += notes
            self._pilot.command(command)

    def _pause(self, paused: bool) -> None:
        if paused and self._paused_since is None:
            self._paused_since = time.perf_counter()
        elif not paused and self._paused_since is not None:
            self._shift += time.perf_counter() - self._paused_since
            self._paused_since = None


def run_worker(connection: Connection, request: CharacterRequest) -> None:
    """Steer until the other side wants the end; what else ends it is told to the other side, in a line."""
    torch.set_num_threads(1)
    with suppress(ParentClosed, BrokenPipeError):
        try:
            _run_character(connection, request)
        except (
            ParentClosed
        ):  # wanted: nobody is to be told that anything failed, least of all who is started in its place
            return
        except MapctlError as error:
            connection.send(("failed", str(error)))
        except Exception as error:
            last = traceback.extract_tb(error.__traceback__)[-1]
            what = f"{type(error).__name__}: {error}".splitlines()[0]
            connection.send(("failed", f"a character's process ended: {what} ({last.name}, line {last.lineno})"))


def _run_character(connection: Connection, request: CharacterRequest) -> None:
    prior, generator = request.load(), torch.Generator().manual_seed(request.seed)
    first, _ = steer.accept(prior, request.first)
    pilot = Autopilot(first, request.settings.limits)
    desk = ProcessClock(connection, pilot, prior)
    for number in itertools.count():
        state, pose = steer.begin(prior, first, generator=generator, at=request.at, settings=request.settings)
        if number == 0:
            for _ in range(_WARM_UP_STEPS):
                steer.step(state, first)
            connection.send(("ready", None))
        desk.begin(state, pose)
        for _ in iterate_steps(state, pilot, [desk], clock=desk):
            if desk.again:
                break
        first = pilot.at(desk.now())


def _to_frame_chunk(
    frames: SteerFrames, seconds: float, *, at: float, spare: float, notes: tuple[str, ...]
) -> FrameChunk:
    energies = {entry.name: float(entry.energy.mean()) for entry in frames.ledger.entries}
    return FrameChunk(
        at,
        seconds,
        frames.motion.root_position.numpy(),
        frames.motion.local_quat_xyzw.numpy(),
        frames.contacts.numpy(),
        frames.forecast.numpy(),
        frames.steering_targets[-1].velocity,
        energies,
        spare,
        frames.seconds,
        frames.evaluations,
        notes,
    )
