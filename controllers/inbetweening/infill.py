"""Fill the gaps of a motion: frames that are missing, or joints (infilling paper, section 4.2)."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from jaxtyping import Float
from torch import Tensor

from controllers.inbetweening.canonical_gap import CanonicalGap
from controllers.inbetweening.pipeline import Infilled, InfillSettings, Method, end_notes, fill
from controllers.inbetweening.proposers.answers import Answer
from controllers.inbetweening.proposers.rollout import extended
from controllers.inbetweening.proposers.selection import choose_proposals
from mapctl.curves.curve import Curve
from mapctl.errors import RequestError
from mapctl.inbetweening.effector_targets import Targets
from mapctl.inbetweening.missing import Lost, straight
from mapctl.motion import Motion
from mapctl.protocols import Inbetweener
from mapctl.recording.masks import Mask, by_own_names, hidden
from mapctl.retarget import to_canonical
from mapctl.retarget.rigs import Rig

__all__ = ["InfillSettings", "Infilled", "Method", "infill"]


def infill(
    motion: Motion,
    infiller: Inbetweener | None,
    masks: Sequence[Mask],
    *,
    settings: InfillSettings | None = None,
    densities: Sequence[Any] = (),
    rig: Rig | None = None,
    course: Curve | None = None,
    extending: Sequence[Any] = (),
) -> Infilled:
    """Fill what the masks say is missing. RequestError for masks that do not fit, or a method without its network.

    What stands in a gap does not matter. A gap at the motion's beginning or end is extended into: at the end by one of
    the densities `extending`, if what is known is like their data. On a `course` the hips go along it while they are
    lost.
    """
    masks = by_own_names(motion, masks, rig)
    # What rig it is must not be told from what stands in a gap.
    shown = straight(motion, Lost(*hidden(motion, masks)))
    lost = Lost.of_masks(motion, masks, to_canonical(shown, rig)[1])
    if course is not None and not lost.root.any():
        raise RequestError("a curve leads the hips where they are lost, and they never are; leave it out")
    first = "infiller" if settings is None or settings.method != "linear" else "nearest known frame"

    def another(
        gap: CanonicalGap, proposal: Motion, odds: Float[Tensor, "frames 2"], targets: Targets | None
    ) -> Answer:
        chosen = Answer(proposal, odds)
        if course is None:
            chosen = choose_proposals(gap, proposal, odds, targets, densities=extending)
        end = extended(gap, chosen.motion, chosen.odds, densities=extending)
        return replace(end, sources=(*chosen.sources, *end.sources))

    done = fill(motion, lost, infiller, settings=settings, densities=densities, rig=rig, course=course, another=another)
    last = done.sources[-1].by if done.sources and lost.root[-1] else first
    return replace(done, notes=(*end_notes(lost, first, last), *done.notes))
