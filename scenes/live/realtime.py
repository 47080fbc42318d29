"""Whether a character keeps up with the clock, judged within a second."""

from collections import deque

from mapctl.runtime.live_protocol import FrameChunk

_SHORT_SECONDS, _LONG_SECONDS, _RECOVERY_SECONDS = (
    1.0,
    5.0,
    2.0,
)  # seconds: of the quick look, of the long one, and without a late frame to be well
_MAX_SHORT_SHARE, _MAX_LONG_SHARE = (
    0.5,
    0.2,
)  # shares of late frames that are too many in the quick and in the long look
_SILENT_SECONDS = 0.8  # seconds without a frame that count as too late
_MIN_SHARE_FRAMES = 6  # frames of which a share is taken: two steps


class RealtimeMonitor:
    """Lateness of one character over the last seconds.

    It is too slow where half of the last second's frames came late, a fifth of the last five seconds', or none for most
    of a second; and keeps up again after two seconds without a late one.
    """

    def __init__(self):
        self._rows: deque[tuple[float, float, int, int, int]] = deque()  # time, stream, frames, late, evaluations
        self.slow = False
        self._rate = 1.0

    def set_rate(self, rate: float) -> None:
        """Judge by another rate from now on: seconds of the character that are to pass in a second."""
        self._rate = rate
        self.forget()

    def forget(self) -> None:
        """Restart: it was paused or reset, so what is missing is not late."""
        self._rows.clear()

    def add(self, now: float, delivered: FrameChunk) -> None:
        """Add one more step, at a value of time.perf_counter."""
        self._rows.append((now, delivered.seconds, len(delivered.root), delivered.late_frames, delivered.evaluations))
        while self._rows[-1][0] - self._rows[0][0] > _LONG_SECONDS:
            self._rows.popleft()

    def judge(self, now: float) -> bool:
        """Judge whether it has begun or ceased to be too slow."""
        if not self._rows:
            return False
        quick, long = self._compute_late_share(now - _SHORT_SECONDS), self._compute_late_share(now - _LONG_SECONDS)
        silent = now - self._rows[-1][0] > _SILENT_SECONDS / self._rate
        if self.slow:
            changed = (
                not silent
                and self._compute_late_share(now - _RECOVERY_SECONDS) == 0
                and self._rows[0][0] <= now - _RECOVERY_SECONDS
            )
        else:
            changed = (
                silent
                or quick >= _MAX_SHORT_SHARE
                or (long >= _MAX_LONG_SHARE and now - self._rows[0][0] > _LONG_SECONDS - _SHORT_SECONDS)
            )
        self.slow ^= changed
        while changed and not self.slow and self._rows[0][0] <= now - _RECOVERY_SECONDS:
            self._rows.popleft()  # what is over is not judged again
        return changed

    def text(self, now: float) -> str:
        """Describe how slow it is, for a person."""
        if not self._rows:
            return "no frame since it was stopped"
        first, last = self._rows[0], self._rows[-1]
        if (silent := now - last[0]) > _SILENT_SECONDS / self._rate:
            return f"no frame for {silent:.0f} s"
        late = f"{100 * self._compute_late_share(now - _LONG_SECONDS):.0f} % of its frames come late"
        recent = [row for row in self._rows if row[0] > now - _SHORT_SECONDS] or [last]
        searched = sum(row[4] for row in recent) / len(recent)
        rate = (last[1] - first[1]) / max(1e-9, last[0] - first[0]) / self._rate
        slowly = f"it plays at {100 * rate:.0f} % of real time, " if len(self._rows) > 2 and 0 < rate < 0.97 else ""
        return f"{slowly}{late}, {searched:.0f} evaluations a step"

    def _compute_late_share(self, since: float) -> float:
        """Compute the share of late frames among those since then; 0 of very few."""
        frames = sum(row[2] for row in self._rows if row[0] > since)
        return sum(row[3] for row in self._rows if row[0] > since) / frames if frames >= _MIN_SHARE_FRAMES else 0.0
