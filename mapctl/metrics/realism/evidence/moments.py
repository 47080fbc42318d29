"""Moments to go and look at: windows most surely told to be made, with the frame, joint and band that tell them."""

from dataclasses import dataclass

import torch

from mapctl.features import PRIOR_FPS
from mapctl.metrics.realism.evidence.gathering import GatheredEvidence
from mapctl.metrics.realism.evidence.kinds import BODY_PHASES, FOOT_PHASES, GAITS, join_foot_phases
from mapctl.metrics.realism.evidence.parts import BANDS, JOINTS

_APART = PRIOR_FPS  # frames between two moments of one clip
_MOST_PER_CLIP = 2
_SMOOTH = 5  # frames over which evidence is averaged before its peak is taken


@dataclass(frozen=True)
class Moment:
    """A second in which a clip gives itself away."""

    clip: int
    """Index of the clip among the made ones."""
    seconds: float
    """Time in the clip at which the evidence is strongest, seconds at the rate of priors."""
    start: float
    """Begin of the window, seconds."""
    logit: float
    """Logit of the window; 0 is undecided."""
    joint: str
    """Joint with the most evidence."""
    band: str
    """Band with the most evidence, of this joint."""
    phase: str
    """Phase of the joint's own foot at that time for a leg, else of the body."""
    gait: str
    """Gait of the window."""


def list_moments(made: GatheredEvidence, most: int) -> list[Moment]:
    """List the windows that are most surely told, at most two of a clip and a second apart, the surest first."""
    moments: list[Moment] = []
    taken: dict[int, list[int]] = {}
    for row in made.logits.argsort(descending=True).tolist():
        if len(moments) == most or made.logits[row] <= 0:
            break
        clip, first = int(made.labels.clip[row]), int(made.labels.first[row])
        others = taken.setdefault(clip, [])
        if len(others) == _MOST_PER_CLIP or any(abs(first - other) < _APART for other in others):
            continue
        others.append(first)
        moments.append(_describe(made, row))
    return moments


def _describe(made: GatheredEvidence, row: int) -> Moment:
    cells = made.evidence.cells[row]
    joint = int(cells.sum(dim=0).argmax())
    over_time = made.evidence.frames[row, :, joint]
    side = min(_SMOOTH // 2, (len(over_time) - 1) // 2)
    smooth = torch.nn.functional.avg_pool1d(over_time[None, None], 2 * side + 1, 1, side)[0, 0]
    peak, first = int(smooth.argmax()), int(made.labels.first[row])
    feet = made.labels.feet[row, peak]
    return Moment(
        int(made.labels.clip[row]),
        (first + peak) / PRIOR_FPS,
        first / PRIOR_FPS,
        float(made.logits[row]),
        JOINTS[joint],
        BANDS[int(cells[:, joint].argmax())],
        FOOT_PHASES[int(feet[_side_of(joint)])] if is_leg(joint) else BODY_PHASES[int(join_foot_phases(feet))],
        GAITS[int(made.labels.gait[row])],
    )


def is_leg(joint: int) -> bool:
    """Return whether the foot's phase is the joint's own: lower legs, feet and toes."""
    return JOINTS[joint].endswith(("LowerLeg", "Foot", "Toes"))


def _side_of(joint: int) -> int:
    return 1 if JOINTS[joint].startswith("right") else 0
