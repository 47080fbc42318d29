"""Recordings of motion: their masks, artefacts, noise, spikes and gaps, and their fusion with a proposal."""

from mapctl.recording.recording import Capture, CaptureProposal

__all__ = ["Capture", "CaptureProposal"]
