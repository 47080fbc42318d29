"""What a capture shows, what it does not, and how noisy it is."""

from mapctl.capture.cleaned import Cleaned
from mapctl.capture.observed import Capture, filled, last_seen, next_seen

__all__ = ["Capture", "Cleaned", "filled", "last_seen", "next_seen"]
