"""Gaps in a motion: what is known of it, and what an in-betweener is shown and proposes."""

from mapctl.inbetweening.position_image import PositionImage, ProposedPositions

__all__ = ["PositionImage", "ProposedPositions"]
