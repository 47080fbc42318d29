"""Recordings of motion: their masks, artefacts, noise, spikes and gaps, and how they are split into frequency bands."""

from mapctl.recording.proposal import CaptureProposal
from mapctl.recording.recording import Capture

__all__ = ["Capture", "CaptureProposal"]
