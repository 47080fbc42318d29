"""Gaps in a motion: what is missing, what is asked of an in-betweener, and what it proposes."""

from mapctl.inbetweening.position_image import PositionImage, ProposedPositions
from mapctl.inbetweening.query import GapQuery, Proposal

__all__ = ["GapQuery", "PositionImage", "Proposal", "ProposedPositions"]
