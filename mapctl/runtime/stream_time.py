"""Time of a stream that can be paused, set back, and made slower than real time."""

import time

RATES = (1 / 64, 1.0)
"""Slowest and fastest rate of a stream's time, seconds of the stream per second."""


class StreamTime:
    """Seconds that pass at a rate, and not while it is paused; as long as the rate is 1 and nothing was set back it is
    time.perf_counter."""

    def __init__(self):
        self._at = self._real = time.perf_counter()  # a moment: of the stream, and of time.perf_counter
        self.rate = 1.0
        """Seconds of the stream per second, also while it is paused."""
        self.is_paused = False

    def now(self) -> float:
        """Return the time of the stream, seconds."""
        return self._at if self.is_paused else self._at + self.rate * (time.perf_counter() - self._real)

    def pause(self, paused: bool) -> None:
        """Stop, or go on."""
        self._mark()
        self.is_paused = paused

    def set_rate(self, rate: float) -> None:
        """Pass at another rate from now on."""
        self._mark()
        self.rate = rate

    def hold(self, seconds: float) -> None:
        """Set it back by so many seconds of the stream."""
        self._at -= seconds

    def wait_seconds(self, until: float) -> float | None:
        """Return the real seconds until a time of the stream, 0 where it has passed; None while it is paused."""
        return None if self.is_paused else max(0.0, (until - self.now()) / self.rate)

    def perf_counter_at(self, seconds: float) -> float:
        """Return the value of time.perf_counter at a time of the stream, if nothing changes until then."""
        return self._real + (seconds - self._at) / self.rate

    def _mark(self) -> None:
        self._at, self._real = self.now(), time.perf_counter()
