"""Interpolation as an in-betweener: joints by slerp, the root linearly, or along the trajectory that a query keeps.

A walk over keys that give positions alone: a density follows a curve through them in time (Wang et al. 2019,
section 5.2).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import scipy
import torch
from jaxtyping import Float
from torch import Tensor

from controllers.common.character import Character
from controllers.inbetweening.proposers.partial_keys import meet_partial_keys
from controllers.shots.walk import FollowSettings, walk_arcs
from mapctl import contacts, curves
from mapctl.curves import Curve
from mapctl.features import LAYOUT, PRIOR_FPS
from mapctl.inbetweening import GapQuery, Proposal
from mapctl.inbetweening.query import INTERPOLATION, GapSource, estimate_contact_logits
from mapctl.protocols import Density, Inbetweener


class SlerpInbetweener(Inbetweener):
    """In-betweener that proposes the query's interpolation; before and after all known frames poses are held."""

    def propose(self, query: GapQuery, *, generator: torch.Generator | None = None) -> Proposal:
        """Propose the query's own motion, with contacts where its toes are low and slow."""
        return Proposal(query.motion, estimate_contact_logits(query.motion), "slerp")


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
        """Propose for each gap the stitcher's motion, bent to its partial keys; gaps that it leaves are the other's,
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


_LEAST_WAY = 0.3  # metres from place to place, at the canonical size, that are walked and not stood


def lay_curve(query: GapQuery, fastest: float, ahead: int) -> tuple[Curve, Float[Tensor, " ahead"]] | None:
    """Lay a curve through the places of a query of which they are all that is given, from its first frame to its last,
    metres at the canonical size; also return the arcs of the frames and of so many `ahead` of them, metres. None where
    there are others, and where the body would stand, or be faster than `fastest`, m/s."""
    loose = query.loose
    if loose is None or not query.only_places:
        return None
    frames = loose.placed.nonzero()[:, 0]
    if len(frames) < 2 or int(frames[0]) > 0 or int(frames[-1]) < query.motion.num_frames - 1:
        return None
    places = loose.ground[frames].double() / query.scale
    ways = torch.diff(places, dim=0).norm(dim=-1)
    speeds = ways * PRIOR_FPS / torch.diff(frames)
    if float(ways.min()) < _LEAST_WAY or float(speeds.max()) > fastest:
        return None
    curve = curves.through(places)
    at = _find_arcs(curve, places)
    if float(torch.diff(at).min()) <= 0:
        return None
    timed = scipy.interpolate.PchipInterpolator(frames.numpy(), at.numpy())
    inside = torch.as_tensor(timed(torch.arange(int(frames[-1]) + 1).numpy()))
    speed = float(inside[-1] - inside[-2])
    return curve, torch.cat([inside, inside[-1] + speed * torch.arange(1, ahead + 1)])


def walk_over_places(
    query: GapQuery, densities: Sequence[Density], generator: torch.Generator | None
) -> Proposal | None:
    """Propose a walk over places by the first density, that of locomotion; None where it is not one that the density
    knows (see `lay_curve`)."""
    settings = FollowSettings()
    laid = lay_curve(query, densities[0].limits.fastest, settings.window.frames) if densities else None
    if laid is None:
        return None
    curve, arcs = laid
    frames = query.motion.num_frames
    motion, done, _ = walk_arcs(
        densities[0],
        curve,
        arcs,
        frames,
        character=Character(),
        settings=settings,
        generator=generator or torch.Generator().manual_seed(0),
    )
    root, source = motion.root_position * query.scale, f"walk of {densities[0].name}"
    planted = done.features[:, LAYOUT.slices["contacts"]] > 0.5
    return Proposal(
        replace(query.motion, root_position=root, local_quat_xyzw=motion.local_quat_xyzw),
        contacts.to_logits(planted),
        source,
        (GapSource(0, frames, source, "along a curve through the places, which are all that keys tell"),),
    )


def _find_arcs(curve: Curve, places: Float[Tensor, "places 2"]) -> Float[Tensor, " places"]:
    """Find the arcs of the places that a curve leads through, metres."""
    dense = torch.linspace(0, curve.length, max(2, round(100 * curve.length)), dtype=torch.float64)
    points, found, first = curve.ground_point(dense), [], 0
    for place in places[:-1]:
        # A curve that crosses itself comes by twice.
        away = (points[first:] - place).norm(dim=-1)
        near = (away < float(away.min()) + 0.01).nonzero()[0, 0] if len(found) else away.argmin()
        first += int(near)
        found.append(float(dense[first]))
    return torch.tensor([*found, curve.length], dtype=torch.float64)
