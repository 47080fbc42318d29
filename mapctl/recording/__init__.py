"""Recordings of motion: their masks, artefacts, noise, spikes and gaps, and how they are split into frequency bands."""

from mapctl.numerics.intervals import fill_missing, last_observed, next_observed
from mapctl.recording.proposal import CaptureProposal
from mapctl.recording.recording import Capture

__all__ = ["Capture", "CaptureProposal", "fill_missing", "last_observed", "next_observed"]
