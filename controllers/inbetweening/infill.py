"""Fill the gaps of a motion: frames that are missing, or joints (Kaufmann et al. 2020, section 4.2)."""

from collections.abc import Sequence

import torch

from controllers.inbetweening.pipeline import InfillSettings, fill
from controllers.inbetweening.solution import InbetweenSolution
from mapctl.curves.curve import Curve
from mapctl.errors import RequestError
from mapctl.inbetweening.missing import MissingMask, interpolate_missing
from mapctl.motion import Motion
from mapctl.protocols import Density, Inbetweener
from mapctl.recording.masks import Mask, expand_masks, resolve_joint_names
from mapctl.retarget import to_canonical
from mapctl.retarget.rigs import Rig
from mapctl.terms import Term

__all__ = ["InbetweenSolution", "InfillSettings", "infill"]


def infill(
    motion: Motion,
    inbetweener: Inbetweener,
    masks: Sequence[Mask],
    *,
    settings: InfillSettings | None = None,
    densities: Sequence[Density] = (),
    terms: Sequence[Term] = (),
    rig: Rig | None = None,
    course: Curve | None = None,
    generator: torch.Generator | None = None,
) -> InbetweenSolution:
    """Fill what the masks say is missing. RequestError for masks that do not fit.

    What stands in a gap does not matter. A gap at the motion's beginning or end is extended into. On a `course` the
    hips go along it while they are missing; the in-betweener's rough one then proposes, since others leave it. Of
    `densities` the likeliest joins the MAP stage, and so do `terms`; what is drawn is drawn from the generator.
    """
    masks = resolve_joint_names(motion, masks, rig)
    # What rig it is must not be told from what stands in a gap.
    shown = interpolate_missing(motion, MissingMask(*expand_masks(motion, masks)))
    missing = MissingMask.of_masks(motion, masks, to_canonical(shown, rig)[1])
    if course is not None and not missing.root.any():
        raise RequestError("a curve leads the hips where they are lost, and they never are; leave it out")
    return fill(
        motion,
        missing,
        inbetweener if course is None else inbetweener.rough,
        settings=settings,
        densities=densities,
        terms=terms,
        rig=rig,
        course=course,
        generator=generator,
    )
