"""Gaps in a motion: what is known of it, and an in-betweener's input and proposal."""

from mapctl.inbetweening.position_image import PositionImage, ProposedPositions

__all__ = ["PositionImage", "ProposedPositions"]
