"""Proposals through loose keys, which tell no rotation: places of the hips over the ground, and drawings.

Whoever proposes, places are met by spreading what the way misses them by in proportion to the way walked. A drawn pose
is fitted about what is proposed without it, or with it as far as the in-betweener sees drawings; then it is a pose like
others, and all is proposed again through it.
"""

from dataclasses import replace

import torch

from controllers.inbetweening.geometry.drawn_poses import fit_drawings, measure_drawing_error
from mapctl.inbetweening import GapQuery, Proposal
from mapctl.inbetweening.missing import MissingMask, interpolate_missing
from mapctl.inbetweening.path_closing import lead_over_keys
from mapctl.motion import Motion
from mapctl.protocols import Inbetweener

_REPORTED_ERROR = 0.03  # metres from where a joint is drawn, on average, beyond which there is a note


def show_drawn_poses(query: GapQuery, inbetweener: Inbetweener, generator: torch.Generator) -> GapQuery:
    """Return a query that has poses instead of drawings, fitted about what an in-betweener proposes; their place stays
    open where it is not told."""
    loose = query.loose
    if loose is None or not bool(loose.drawn.any()):
        return query
    first = inbetweener.propose(query, generator=generator).motion
    fitted = fit_drawings(first, loose, faced=not bool(query.missing.joints[:, 0].all()))
    drawn = loose.drawings
    root, quats = query.motion.root_position.clone(), query.motion.local_quat_xyzw.clone()
    quats[drawn], root[drawn, 1] = fitted.local_quat_xyzw[drawn], fitted.root_position[drawn, 1]
    missing = MissingMask(query.missing.joints & ~drawn[:, None], query.missing.root)
    shown = interpolate_missing(replace(query.motion, local_quat_xyzw=quats), missing)
    places = replace(loose, drawn=torch.zeros_like(loose.drawn))
    return replace(query, motion=replace(shown, root_position=root), missing=missing, loose=places)


def meet_places(proposal: Proposal, query: GapQuery) -> Proposal:
    """Lead the hips of a proposal over the places of loose keys."""
    if query.loose is None or not bool(query.loose.placed.any()):
        return proposal
    motion, known, lost = proposal.motion, query.motion.root_position, query.missing.root
    root = lead_over_keys(motion.root_position, known, lost, query.loose)
    return replace(proposal, motion=replace(motion, root_position=root))


def hold_loose_keys(query: GapQuery) -> MissingMask:
    """Return what is missing when the hips stay at their places, over the ground and as high as proposed."""
    missing = query.missing
    return missing if query.loose is None else MissingMask(missing.joints, missing.root & ~query.loose.placed)


def note_drawings(motion: Motion, query: GapQuery) -> tuple[str, ...]:
    """Note drawings of a query that a motion does not look like."""
    if query.loose is None:
        return ()
    places, frames = motion.joint_positions(), query.loose.drawings.nonzero()[:, 0].tolist()
    missed = {frame: measure_drawing_error(places[frame], query.loose, frame) for frame in frames}
    return tuple(
        f"at {float(query.seconds[frame]):.2f} s joints stay {100 * error:.0f} cm from where they are drawn, on"
        " average: bones do not look so"
        for frame, error in missed.items()
        if error > _REPORTED_ERROR
    )
