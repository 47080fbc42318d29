"""Who is told how training goes: step by step, at each validation, and in lines for a log."""

import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

Row = dict[str, Any]
"""Losses of a step, or measures of held-out clips, by name; None for what is not finite."""
FIRST_LINE_SECONDS, LINE_SECONDS = 5.0, 30.0
"""From the beginning to the first line of a log, and from line to line, seconds."""
_REMEMBERED_STEPS = 200  # steps by whose mean duration those to come are told


@dataclass(frozen=True)
class RunStart:
    """What a run is when it begins or goes on."""

    kind: str
    """Kind of model."""
    counter: str
    """What a step is called."""
    step: int
    """Steps that are done already."""
    steps: int
    """Steps in all."""
    validate_steps: int
    """Steps from one validation to the next."""
    format_news: Callable[[Sequence[Row]], str]
    """One line on the losses of some steps."""


class Watcher:
    """Told of a run's course; this one does nothing with it."""

    def begin(self, start: RunStart) -> None:
        """Before the first step of this process."""

    def see_step(self, step: int, losses: Row) -> None:
        """After each step."""

    def see_losses(self, step: int, means: Row) -> None:
        """Mean losses of the steps since the last such row, every report_steps and at the end."""

    def see_validation(self, step: int, measures: Row) -> None:
        """After each validation."""

    def see_end(self, steps: int) -> None:
        """The run has so many steps in all: that is decided while it goes on, where its length was not told."""

    def end(self) -> None:
        """After the last step of this process, however it ends."""


class Pace:
    """How fast a run goes, and how long it still takes."""

    def __init__(self, clock: Callable[[], float] = time.monotonic):
        self._clock = clock
        self._last = self._began = clock()
        self._steps: deque[float] = deque(maxlen=_REMEMBERED_STEPS)
        self._validations: deque[float] = deque(maxlen=10)

    def mark_step(self) -> None:
        """A step has ended."""
        self._steps.append(self._lap())

    def mark_validation(self) -> None:
        """A validation has ended."""
        self._validations.append(self._lap())

    @property
    def elapsed(self) -> float:
        """Seconds since the beginning."""
        return self._clock() - self._began

    @property
    def rate(self) -> float | None:
        """Steps a second over the last steps; None before the first."""
        seconds = sum(self._steps)
        return len(self._steps) / seconds if seconds > 0 else None

    def find_remaining(self, steps: int, validations: int) -> float | None:
        """Seconds that so many steps and validations take; None before the first step."""
        rate = self.rate
        if rate is None:
            return None
        validation = sum(self._validations) / len(self._validations) if self._validations else 0.0
        return steps / rate + validations * validation

    def _lap(self) -> float:
        now = self._clock()
        seconds, self._last = now - self._last, now
        return seconds


class PacedWatcher(Watcher):
    """Keeps the pace, for those that tell it."""

    def __init__(self, clock: Callable[[], float] = time.monotonic):
        self._clock = clock
        self.start: RunStart | None = None
        self.pace = Pace(clock)
        self.step = self._validated = 0

    def begin(self, start: RunStart) -> None:
        """Before the first step of this process."""
        self.start, self.step, self.pace = start, start.step, Pace(self._clock)
        self._validated = start.step

    def see_step(self, step: int, losses: Row) -> None:
        """After each step."""
        self.step = step
        self.pace.mark_step()

    def see_validation(self, step: int, measures: Row) -> None:
        """After each validation."""
        self._validated = step
        self.pace.mark_validation()

    def see_end(self, steps: int) -> None:
        """The run has so many steps in all."""
        assert self.start is not None
        self.start = replace(self.start, steps=steps)

    def format_pace(self) -> str:
        """The rate and the time that is left."""
        assert self.start is not None
        rate, left = self.pace.rate, self.find_remaining()
        if rate is None or left is None:
            return "no rate yet"
        per = f"{rate:.1f} {self.start.counter}s/s" if rate >= 1 else f"{1 / rate:.1f} s a {self.start.counter}"
        return f"{per}, {format_duration(left)} left"

    def find_remaining(self) -> float | None:
        """Seconds to the end of the run; None before the first step."""
        assert self.start is not None
        every = self.start.validate_steps
        validations = -(-self.start.steps // every) - self._validated // every
        if self._validated >= self.start.steps:
            validations = 0
        return self.pace.find_remaining(max(0, self.start.steps - self.step), max(0, validations))


class LineWatcher(PacedWatcher):
    """Says in lines how it goes: at every report, or, with a `log`, by the clock."""

    def __init__(self, say: Callable[[str], None], *, log: bool = False, clock: Callable[[], float] = time.monotonic):
        """`log` says a line soon after the beginning, then every half minute, and at the end."""
        super().__init__(clock)
        self._say, self._log = say, log
        self._rows: list[Row] = []
        self._due = 0.0

    def begin(self, start: RunStart) -> None:
        """Before the first step of this process."""
        super().begin(start)
        self._rows, self._due = [], self._clock() + FIRST_LINE_SECONDS

    def see_step(self, step: int, losses: Row) -> None:
        """After each step."""
        super().see_step(step, losses)
        self._rows.append(losses)
        assert self.start is not None
        if self._log and (self._clock() >= self._due or step >= self.start.steps):
            self._say_losses()
            self._due = self._clock() + LINE_SECONDS

    def see_losses(self, step: int, means: Row) -> None:
        """A line at every report."""
        if not self._log:
            self._say_losses()

    def see_validation(self, step: int, measures: Row) -> None:
        """A line on each validation."""
        super().see_validation(step, measures)
        assert self.start is not None
        told = ", ".join(f"{name} {format_number(value)}" for name, value in measures.items())
        self._say(f"validation at {self.start.counter} {step}: {told}")

    def _say_losses(self) -> None:
        start, rows = self.start, self._rows
        self._rows = []
        if start is not None and rows:
            news = start.format_news(rows)
            self._say(f"{start.counter} {self.step}/{start.steps}: {news}, {self.format_pace()}")


def format_number(value: float | None) -> str:
    """Four digits; a dash for what is not finite."""
    return "-" if value is None or value != value else f"{value:.4g}"


def format_duration(seconds: float) -> str:
    """As in 0:01:05."""
    whole = round(seconds)
    return f"{whole // 3600}:{whole // 60 % 60:02d}:{whole % 60:02d}"
