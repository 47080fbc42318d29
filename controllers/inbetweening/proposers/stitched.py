"""Stitched gaps, bent to what is told of parts of the body, and another in-betweener for what cannot be stitched."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import torch

from controllers.inbetweening.proposers.partial_keys import meet_partial_keys
from mapctl.inbetweening import GapQuery, Proposal
from mapctl.inbetweening.query import INTERPOLATION, GapSource
from mapctl.protocols import Inbetweener


@dataclass(frozen=True, eq=False)
class StitchedInbetweener(Inbetweener):
    """In-betweener that fills gaps between two whole poses from both sides (Ren et al. 2024), and leaves all others to
    another one."""

    stitcher: Inbetweener
    """In-betweener that leaves interpolated what it cannot fill, and says why."""
    load_fallback: Callable[[], Inbetweener]
    """Loader of the in-betweener for the rest, called where there is some."""

    @property
    def takes_partial_keys(self) -> bool:
        """Whether they reach `propose`; they are hidden there from who does not take them."""
        return True

    def propose(self, query: GapQuery, *, generator: torch.Generator | None = None) -> Proposal:
        """Propose for each gap the stitcher's motion, bent to what is told of it in part; what it left is the other's,
        and the proposal says why."""
        stitched = self.stitcher.propose(query, generator=generator)
        sources = stitched.attribute(query)
        left = [source for source in sources if source.by == INTERPOLATION]
        if len(left) < len(sources):
            stitched = meet_partial_keys(query, stitched)[0]
        if not left:
            return stitched
        fallback = self.load_fallback()
        asked = query if fallback.takes_partial_keys else query.hide_partial_keys()
        made = fallback.propose(asked, generator=generator)
        made = replace(made, others=_pass_on(left, made))
        return made if len(left) == len(sources) else _put_in(stitched, made, query)


def _pass_on(left: list[GapSource], made: Proposal) -> tuple[GapSource, ...]:
    """Name who made what was left, and both reasons if that one had another to leave it on."""
    named = {source.start: source for source in made.others}
    passed = []
    for source in left:
        own = named.pop(source.start, GapSource(source.start, source.stop, made.source))
        reason = "; ".join(filter(None, (source.reason, own.reason)))
        passed.append(replace(own, reason=reason))
    return (*passed, *named.values())


def _put_in(stitched: Proposal, made: Proposal, query: GapQuery) -> Proposal:
    """Put the gaps that were stitched into another proposal."""
    sources = [source for source in stitched.attribute(query) if source.by != INTERPOLATION]
    starts = {source.start for source in sources}
    others = (*(other for other in made.others if other.start not in starts), *sources)
    # Partial keys divide a gap, and are the stitcher's too.
    whole = query.hide_partial_keys().enclosed_gaps
    gaps = [gap for gap in whole if any(gap[0] <= start < gap[1] for start in starts)]
    return replace(made.take(stitched, gaps), others=others)
