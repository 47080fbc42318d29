"""Extrapolation beyond the last known frame: the likeliest rollout of a density after the frames before."""

from collections.abc import Sequence
from dataclasses import replace

import torch

from controllers.inbetweening.proposers.rolling import commit_before, insert_rollout, select_likeliest_density
from controllers.inbetweening.proposers.rollouts import RolloutSettings
from mapctl.inbetweening import GapQuery, Proposal
from mapctl.inbetweening.query import GapSource
from mapctl.problem import density_selection
from mapctl.problem.receding_horizon import RecedingHorizonSolver
from mapctl.problem.warm_start import keep_warm_start
from mapctl.protocols import Density
from mapctl.terms import LatentPrior

_MIN_KNOWN_FRAMES = 5  # fewest frames from which a motion is extrapolated


def extrapolate_end(
    query: GapQuery, proposal: Proposal, densities: Sequence[Density], settings: RolloutSettings
) -> Proposal:
    """Extrapolate a proposal from the last known frame to its end, if nothing is known there.

    It stays unchanged where the first density (that of locomotion) does not find the frames before as likely as its own
    data: densities then stop or turn away. None runs backwards, so a beginning stays as well.
    """
    missing, stop = query.nothing_known, query.motion.num_frames
    start = stop - int(missing.flip(0).long().cumprod(0).sum())
    # Only frames since the gap before count, not what fills that.
    since = int(missing[:start].nonzero()[-1]) + 1 if bool(missing[:start].any()) else 0
    if start == stop or start - since < _MIN_KNOWN_FRAMES or not densities:
        return proposal
    body, logits = query.to_unit_size(proposal.motion), proposal.contact_logits
    known = body.slice(since, start)
    blurred = densities[0].with_observation_noise(density_selection.proposal_sigma())
    if density_selection.select_density_for_motion([blurred], known).weight < 1:
        return proposal
    density = select_likeliest_density(densities, known)
    solver = RecedingHorizonSolver(density, method=replace(settings.method, proposal=keep_warm_start))
    for first in range(start, stop, settings.longest):
        committed, count = commit_before(body, logits, first, density), min(settings.longest, stop - first)
        terms = (LatentPrior(settings.sigma_noise), settings.footing)
        window = solver.solve_window(committed, terms, count, generator=torch.Generator())
        body, logits = insert_rollout(body, logits, window, committed.place, (first, first + count))
    source = GapSource(start, stop, f"density {density.name}")
    return replace(proposal, motion=query.to_character(body), contact_logits=logits, others=(*proposal.others, source))
