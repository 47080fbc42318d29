"""Budget of a solve, and the meter that is asked before every evaluation."""

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, replace


@dataclass(frozen=True)
class Budget:
    """Limits of one solve; None is no limit."""

    evaluations: int | None = None
    """Evaluations of the energy, with or without gradient; a batch counts every candidate in it."""
    seconds: float | None = None
    """Time from the making of the meter, seconds."""
    evaluation_seconds: float | None = None
    """Time of an evaluation, seconds, as far as known: one that would end after `seconds` is not begun. Later ones are
    expected to take as long as the last. None asks for the time at the beginning alone."""

    def within(self, seconds: float) -> "Budget":
        """Return this budget, ending after so many seconds at the latest; infinity leaves it as it is."""
        return replace(self, seconds=seconds if self.seconds is None else min(self.seconds, seconds))


class Meter:
    """Counts evaluations against a budget; the clock starts with the meter. It refuses, and never raises."""

    def __init__(self, budget: Budget = Budget(), *, clock: Callable[[], float] = time.monotonic):
        self.budget = budget
        self.evaluations = 0
        self._clock = clock
        self._began = self._taken_at = clock()
        self._expected, self._taken = budget.evaluation_seconds or 0.0, 0

    def take(self, count: int = 1) -> bool:
        """Ask for `count` evaluations at once: True counts them; False counts none, make none."""
        now = self._clock()
        if self.budget.evaluation_seconds is not None and self._taken:
            self._expected = (now - self._taken_at) / self._taken
        if self._late(count) or count > self.remaining:
            return False
        self._taken_at, self._taken = now, count
        self.evaluations += count
        return True

    @property
    def remaining(self) -> float:
        """Evaluations that are left: a whole number, or infinity; none after the deadline."""
        limit = math.inf if self.budget.evaluations is None else self.budget.evaluations
        return 0 if self._late() else max(0, limit - self.evaluations)

    def _late(self, count: int = 1) -> bool:
        now = self._clock() - self._began
        return self.budget.seconds is not None and now + count * self._expected >= self.budget.seconds
