"""Recordings of motion: their masks, artefacts, noise, spikes and gaps, and their fusion with a proposal."""

from mapctl.recording.proposal import CaptureProposal
from mapctl.recording.recording import Capture

__all__ = ["Capture", "CaptureProposal"]
