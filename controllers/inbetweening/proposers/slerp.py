"""Interpolation as an in-betweener: joints by slerp, the root linearly, or along the trajectory that a query keeps."""

import torch

from mapctl.inbetweening import GapQuery, Proposal
from mapctl.inbetweening.query import estimate_contact_logits
from mapctl.protocols import Inbetweener


class SlerpInbetweener(Inbetweener):
    """In-betweener that proposes the query's interpolation; before and after all known frames poses are held."""

    def propose(self, query: GapQuery, *, generator: torch.Generator | None = None) -> Proposal:
        """Propose the query's own motion, with contacts where its toes are low and slow."""
        return Proposal(query.motion, estimate_contact_logits(query.motion), "slerp")
