"""What a capture shows, what it does not, and how noisy it is."""

from mapctl.numerics.intervals import filled, last_seen, next_seen
from mapctl.recording.cleaned import Cleaned
from mapctl.recording.recording import Capture

__all__ = ["Capture", "Cleaned", "filled", "last_seen", "next_seen"]
