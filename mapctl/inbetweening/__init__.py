"""Gaps in a motion: the missing values, the query to an in-betweener, and its proposal."""

from mapctl.inbetweening.position_image import PositionImage, ProposedPositions
from mapctl.inbetweening.query import GapQuery, Proposal

__all__ = ["GapQuery", "PositionImage", "Proposal", "ProposedPositions"]
