"""What a capture shows, what it does not, and how noisy it is."""

from mapctl.capture.observed import Capture, filled, last_seen, next_seen

__all__ = ["Capture", "filled", "last_seen", "next_seen"]
