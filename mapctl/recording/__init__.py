"""What a capture shows, what it does not, and how noisy it is."""

from mapctl.numerics.intervals import fill_missing, last_observed, next_observed
from mapctl.recording.proposal import CaptureProposal
from mapctl.recording.recording import Capture

__all__ = ["Capture", "CaptureProposal", "fill_missing", "last_observed", "next_observed"]
