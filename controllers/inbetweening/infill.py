"""Fill the gaps of a motion: frames that are missing, or joints (Kaufmann et al. 2020, section 4.2); or the hips'
trajectory alone, told by the body (Zhou et al. 2020, section 3.4).
"""

from collections.abc import Sequence

import torch

from controllers.inbetweening.pipeline import InfillSettings, fill
from controllers.inbetweening.proposers.retraced import RetracedInbetweener
from controllers.inbetweening.solution import InbetweenSolution
from mapctl.curves.curve import Curve
from mapctl.errors import RequestError
from mapctl.inbetweening.missing import MissingMask, interpolate_missing
from mapctl.motion import Motion
from mapctl.protocols import Density, Inbetweener, PathPredictor
from mapctl.recording.masks import Mask, expand_masks, resolve_joint_names
from mapctl.retarget import identify_rig
from mapctl.retarget.rigs import Rig
from mapctl.terms import Term

__all__ = ["InbetweenSolution", "InfillSettings", "infill", "retraced"]


def infill(
    motion: Motion,
    inbetweener: Inbetweener,
    masks: Sequence[Mask],
    *,
    settings: InfillSettings | None = None,
    densities: Sequence[Density] = (),
    terms: Sequence[Term] = (),
    rig: Rig | None = None,
    curve: Curve | None = None,
    generator: torch.Generator | None = None,
) -> InbetweenSolution:
    """Fill what the masks say is missing. RequestError for masks that do not fit.

    Values within a gap are ignored. A gap at the motion's beginning or end is extrapolated. Along a `curve` the hips go
    while they are missing; the in-betweener's rough one then proposes, since others leave it. Of `densities` the
    likeliest joins the MAP stage, and so do `terms`; all sampling is from the generator.
    """
    masks = resolve_joint_names(motion, masks, rig)
    # The rig must not be identified from values within a gap.
    shown = interpolate_missing(motion, MissingMask(*expand_masks(motion, masks)))
    missing = MissingMask.of_masks(motion, masks, identify_rig(shown.skeleton, rig, motion=shown))
    if curve is not None and not missing.root.any():
        raise RequestError("the hips follow a curve where they are missing, and they never are; leave it out")
    return fill(
        motion,
        missing,
        inbetweener if curve is None else inbetweener.rough,
        settings=settings,
        densities=densities,
        terms=terms,
        rig=rig,
        curve=curve,
        generator=generator,
    )


def retraced(
    motion: Motion,
    path: PathPredictor,
    masks: Sequence[Mask],
    *,
    inbetweener: Inbetweener | None = None,
    settings: InfillSettings | None = None,
    densities: Sequence[Density] = (),
    terms: Sequence[Term] = (),
    rig: Rig | None = None,
    generator: torch.Generator | None = None,
) -> InbetweenSolution:
    """Predict where the hips go while the masks say that their position is lost (`ROOT`); known frames stay to the bit.

    Masks of joints and of everything are gaps, which the `inbetweener` fills first; where both meet, the trajectory
    goes by the filled poses. Where no position is known at all the trajectory begins over the origin. RequestError for
    masks that do not fit, for gaps without an in-betweener, and for gaps in a motion without any position.
    """
    masks = resolve_joint_names(motion, masks, rig)
    joints, root = expand_masks(motion, masks)
    if bool(joints.any()) and inbetweener is None:
        raise RequestError("joints are missing as well as the trajectory; an in-betweener must propose them")
    if bool(root.all()) and bool(joints.any()):
        raise RequestError("the trajectory is lost over all frames of a motion whose joints are lost as well")
    if not bool(root.any()):
        raise RequestError("no frame's trajectory is lost; there is nothing to predict")
    shown = interpolate_missing(motion, MissingMask(joints, root))
    rigmap = identify_rig(shown.skeleton, rig, motion=shown)
    return fill(
        motion,
        MissingMask.of_masks(motion, masks, rigmap, keep_position=False),
        RetracedInbetweener(path, inbetweener),
        settings=settings,
        densities=densities,
        terms=terms,
        rig=rig,
        generator=generator,
    )
