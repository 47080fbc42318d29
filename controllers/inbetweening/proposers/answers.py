"""What in-betweeners answer: a motion through gaps, its contacts, and who proposed what."""

from collections.abc import Callable
from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor

from controllers.inbetweening.canonical_gap import CanonicalGap
from mapctl.inbetweening.effector_targets import EffectorTargets
from mapctl.motion import Motion


@dataclass(frozen=True)
class GapSource:
    """Who proposed the motion in one gap."""

    start: int
    """First frame of the gap, at the prior's rate."""
    stop: int
    """One past its last."""
    by: str
    """As in `infiller` or `rollout of locomotion`."""


@dataclass(frozen=True, eq=False)
class Proposal:
    """A proposal for all gaps of a motion."""

    motion: Motion
    """On canonical joints at the prior's rate, on the performer's bones."""
    odds: Float[Tensor, "frames 2"]
    """Log odds that the left and the right toe are planted."""
    sources: tuple[GapSource, ...] = ()
    """Of gaps that the infiller did not propose, in the order of time."""


Proposer = Callable[[CanonicalGap, Motion, Float[Tensor, "frames 2"], EffectorTargets | None], Proposal]
"""From what an infiller proposes for a gap, the log odds of its contacts and the places that are wanted on the way, to
another answer."""
