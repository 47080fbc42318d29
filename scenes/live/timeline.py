"""The last two minutes: a frame of the past that is shown instead of the present, and replay."""

import time
from collections.abc import Callable, Sequence

from mapctl.features import PRIOR_FPS
from scenes.live.character import KEPT_SECONDS, ShownCharacter


class Timeline:
    """Looking back stops the characters, so that none moves on unseen; returning lets them go on, unless they were
    paused before."""

    def __init__(
        self, characters: Sequence[ShownCharacter], pause: Callable[[bool], None], is_paused: Callable[[], bool]
    ):
        """`pause` stops all characters, or lets them go on."""
        self._characters, self._pause, self._is_paused = characters, pause, is_paused
        self.seconds_back: float | None = None
        """How far back the shown moment is; None for the present."""
        self._replayed: float | None = None  # value of time.perf_counter up to which was replayed
        self._goes_on = False

    @property
    def kept_seconds(self) -> float:
        """How far back one can look, seconds."""
        return max(len(character.past) for character in self._characters) / PRIOR_FPS

    def look_back(self, seconds: float) -> None:
        """Show what was so many seconds ago, or the oldest frame."""
        if self.seconds_back is None:
            self._goes_on = not self._is_paused()
            self._pause(True)
        self._replayed = None
        self.seconds_back = min(max(0.0, seconds), self.kept_seconds)

    def replay(self) -> None:
        """Play from the shown moment, or from as far back as there is, to the present."""
        self.look_back(self.seconds_back or self.kept_seconds)
        self._replayed = time.perf_counter()

    def return_to_present(self) -> None:
        """Show the present again; characters go on if they went before."""
        if self.seconds_back is not None:
            self.leave()
            if self._goes_on:
                self._pause(False)

    def leave(self) -> None:
        """Show the present again; characters that stand go on standing."""
        self.seconds_back, self._replayed = None, None
        for character in self._characters:
            character.show_past(0)

    def step(self, now: float) -> None:
        """Show the past at a value of time.perf_counter; nothing in the present."""
        if self.seconds_back is not None and self._replayed is not None:
            self.seconds_back -= now - self._replayed
            self._replayed = now
            if self.seconds_back <= 0:
                self.return_to_present()
        if self.seconds_back is not None:
            for character in self._characters:
                character.show_past(round(self.seconds_back * PRIOR_FPS))

    def describe(self) -> str:
        """Describe what is shown, in a line."""
        if self.seconds_back is None:
            kept = self.kept_seconds
            return f"Live. Look back up to {f'{kept:.0f} s' if kept < KEPT_SECONDS - 1 else '2 minutes'}."
        doing = "Past" if self._replayed is None else "Replay"
        return f"**{doing}, {self.seconds_back:.1f} s ago.** The characters wait."
