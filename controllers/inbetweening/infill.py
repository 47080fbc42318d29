"""Fill the gaps of a motion: frames that are missing, or joints (infilling paper, section 4.2)."""

from collections.abc import Sequence
from dataclasses import replace

from jaxtyping import Float
from torch import Tensor

from controllers.inbetweening.canonical_gap import CanonicalGap
from controllers.inbetweening.pipeline import InfillMethod, InfillResult, InfillSettings, fill, note_open_ends
from controllers.inbetweening.proposers.answers import Proposal
from controllers.inbetweening.proposers.rollout import extrapolate_end
from controllers.inbetweening.proposers.selection import choose_proposals
from mapctl.curves.curve import Curve
from mapctl.errors import RequestError
from mapctl.inbetweening.effector_targets import EffectorTargets
from mapctl.inbetweening.missing import MissingMask, interpolate_missing
from mapctl.motion import Motion
from mapctl.protocols import Density, Inbetweener
from mapctl.recording.masks import Mask, expand_masks, resolve_joint_names
from mapctl.retarget import to_canonical
from mapctl.retarget.rigs import Rig

__all__ = ["InfillMethod", "InfillResult", "InfillSettings", "infill"]


def infill(
    motion: Motion,
    infiller: Inbetweener | None,
    masks: Sequence[Mask],
    *,
    settings: InfillSettings | None = None,
    densities: Sequence[Density] = (),
    rig: Rig | None = None,
    course: Curve | None = None,
    rollout_densities: Sequence[Density] = (),
) -> InfillResult:
    """Fill what the masks say is missing. RequestError for masks that do not fit, or a method without its network.

    What stands in a gap does not matter. A gap at the motion's beginning or end is extended into: at the end by one of
    `rollout_densities`, if what is known is like their data. On a `course` the hips go along it while they are lost.
    """
    masks = resolve_joint_names(motion, masks, rig)
    # What rig it is must not be told from what stands in a gap.
    shown = interpolate_missing(motion, MissingMask(*expand_masks(motion, masks)))
    lost = MissingMask.of_masks(motion, masks, to_canonical(shown, rig)[1])
    if course is not None and not lost.root.any():
        raise RequestError("a curve leads the hips where they are lost, and they never are; leave it out")
    first = "infiller" if settings is None or settings.method != "linear" else "nearest known frame"

    def another(
        gap: CanonicalGap, proposal: Motion, odds: Float[Tensor, "frames 2"], targets: EffectorTargets | None
    ) -> Proposal:
        chosen = Proposal(proposal, odds)
        if course is None:
            chosen = choose_proposals(gap, proposal, odds, targets, densities=rollout_densities)
        end = extrapolate_end(gap, chosen.motion, chosen.odds, densities=rollout_densities)
        return replace(end, sources=(*chosen.sources, *end.sources))

    done = fill(motion, lost, infiller, settings=settings, densities=densities, rig=rig, course=course, another=another)
    last = done.sources[-1].by if done.sources and lost.root[-1] else first
    return replace(done, notes=(*note_open_ends(lost, first, last), *done.notes))
