"""The time of the show, its slow motion, and the moment of the past that is shown instead of the present."""

import time
from collections.abc import Callable, Sequence
from typing import Protocol, runtime_checkable

from mapctl.mesh.primitives import Array
from mapctl.runtime.stream_time import StreamTime
from scenes.live.timeline.ring import FrameRing, PastMoment

RATES = {"1": 1.0, "1/2": 0.5, "1/4": 0.25, "1/8": 0.125}
"""Rates of slow motion, seconds of the show per second, by how they are called."""
_TRACK_SECONDS = (4.0, 1.0)  # before and after the moment, of which the track over the ground is shown
_TRACK_POINTS = 31


@runtime_checkable
class Rewindable(Protocol):
    """A character whose past can be shown."""

    ring: FrameRing
    """Frames that it was seen in."""

    def show_past(self, moment: PastMoment, before: Array, after: Array) -> None:
        """Show a moment, and the places (n, 2) to which the root went before and after it, metres."""
        ...

    def show_present(self) -> None:
        """Take away what is shown of the past alone."""
        ...


class Timeline:
    """Who looks at the past stops the characters: none goes on unseen, and no moment slides away meanwhile. They go
    on with the present, unless they stood before."""

    def __init__(self, members: Sequence[Rewindable], pause: Callable[[bool], None]):
        """`pause` stops all characters, or lets them go on, and calls `set_paused`."""
        self._members, self._pause = members, pause
        self.clock = StreamTime()
        self.cursor: float | None = None
        """Time of the show that is looked at, seconds; None for the present."""
        self.is_replaying = False
        self._goes_on, self._replayed = False, 0.0

    @property
    def seconds_back(self) -> float:
        """How far back one looks, seconds; 0 in the present."""
        return 0.0 if self.cursor is None else max(0.0, self.clock.now() - self.cursor)

    @property
    def kept_seconds(self) -> float:
        """How far back one can look, seconds."""
        oldest = [member.ring.oldest for member in self._members if len(member.ring)]
        return max(0.0, self.clock.now() - min(oldest)) if oldest else 0.0

    def look_back(self, seconds: float) -> None:
        """Show what was so many seconds ago, or the oldest frame that is kept. Characters stop for it."""
        if self.cursor is None:
            self._goes_on = not self.clock.is_paused
            self._pause(True)
        self.is_replaying = False
        self.cursor = self.clock.now() - min(max(0.0, seconds), self.kept_seconds)
        self.show()

    def replay(self) -> None:
        """Play from the moment that is looked at, or from as far back as there is, to the present."""
        if self.cursor is None or not self.seconds_back:
            self.look_back(self.kept_seconds)
        self.is_replaying, self._replayed = True, time.perf_counter()

    def return_to_present(self) -> None:
        """Show the present again; characters go on if they went before."""
        goes_on = self._goes_on
        if self.cursor is not None and self._leave() and goes_on:
            self._pause(False)

    def set_paused(self, paused: bool) -> None:
        """Stop the show's time, or let it go on, which shows the present."""
        self.stand(still=paused)
        if not paused:
            self._leave()

    def stand(self, *, still: bool) -> None:
        """Stop the show's time while everybody stands still, or let it go on."""
        if self.clock.is_paused != still:
            self.clock.pause(still)

    def proceed(self, now: float) -> bool:
        """Show what is replayed by now, a value of time.perf_counter; returns whether the past is looked at."""
        if self.cursor is None:
            return False
        if self.is_replaying:
            self.cursor += (now - self._replayed) * self.clock.rate
            self._replayed = now
            if self.cursor >= self.clock.now():
                self.return_to_present()
                return False
            self.show()
        return True

    def show(self) -> None:
        """Show the moment that is looked at."""
        if self.cursor is None:
            return
        before, after = (self.cursor - _TRACK_SECONDS[0], self.cursor), (self.cursor, self.cursor + _TRACK_SECONDS[1])
        for member in self._members:
            if (moment := member.ring.find(self.cursor)) is not None:
                tracks = (member.ring.track(*span, _TRACK_POINTS) for span in (before, after))
                member.show_past(moment, *tracks)

    def _leave(self) -> bool:
        """Leave the past; returns whether one was there."""
        was_past = self.cursor is not None
        self.cursor, self.is_replaying, self._goes_on = None, False, False
        if was_past:
            for member in self._members:
                member.show_present()
        return was_past
