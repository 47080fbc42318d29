"""Fill the gaps of a motion: frames that are missing, or joints (infilling paper, section 4.2)."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from controllers.filling import Infilled, InfillSettings, Method, fill
from mapctl.capture.masks import Mask, hidden
from mapctl.curve import Curve
from mapctl.errors import RequestError
from mapctl.gaps.lost import Lost, straight
from mapctl.motion import Motion
from mapctl.protocols import Inbetweener
from mapctl.retarget import to_canonical
from mapctl.rigs import Rig

__all__ = ["InfillSettings", "Infilled", "Method", "infill"]


def infill(
    motion: Motion, infiller: Inbetweener | None, masks: Sequence[Mask], *,
    settings: InfillSettings | None = None, densities: Sequence[Any] = (), rig: Rig | None = None,
    course: Curve | None = None,
) -> Infilled:  # fmt: skip
    """Fill what the masks say is missing. RequestError for masks that do not fit, or a method without its network.

    What stands in a gap does not matter. A gap at the motion's beginning or end is extended into. On a
    `course` the hips go along it while they are lost.
    """
    # What rig it is must not be told from what stands in a gap.
    shown = straight(motion, Lost(*hidden(motion, masks)))
    lost = Lost.of_masks(motion, masks, to_canonical(shown, rig)[1])
    if course is not None and not lost.root.any():
        raise RequestError("a curve leads the hips where they are lost, and they never are; leave it out")
    done = fill(motion, lost, infiller, settings=settings, densities=densities, rig=rig, course=course)
    return replace(done, notes=_notes(lost))


def _notes(lost: Lost) -> tuple[str, ...]:
    """Gaps that have one edge only."""
    notes = []
    if bool(lost.root[0]):
        notes.append("a gap at the beginning: the motion is extended backwards, with nothing before it to meet")
    if bool(lost.root[-1]):
        notes.append("a gap at the end: the motion is extended, with nothing after it to meet")
    return tuple(notes)
