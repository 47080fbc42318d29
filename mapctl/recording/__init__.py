"""What a capture shows, what it does not, and how noisy it is."""

from mapctl.recording.cleaned import Cleaned
from mapctl.recording.recording import Capture, filled, last_seen, next_seen

__all__ = ["Capture", "Cleaned", "filled", "last_seen", "next_seen"]
