"""Solution of in-betweening: a complete motion, what of it was missing, and who proposed it."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import torch
from jaxtyping import Bool
from torch import Tensor

from mapctl.inbetweening.missing import MissingMask
from mapctl.inbetweening.query import GapSource
from mapctl.numerics.intervals import true_intervals
from mapctl.problem.solution import Solution
from mapctl.retarget.rigs import Rig


@dataclass(frozen=True)
class Pick:
    """Which of several answers this is."""

    name: str
    """Name of this answer."""
    energies: Mapping[str, float]
    """Mean energies of a frame by the names of all answers, nats."""


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class InbetweenSolution(Solution):
    """A complete motion on the given rig, at its rate, with all of its frames."""

    missing: MissingMask
    """Values that were filled in, by joint of the rig."""
    rig: Rig
    """The rig as it was identified."""
    contacts: Bool[Tensor, "frames 2"] = field(default_factory=lambda: torch.zeros(0, 2, dtype=torch.bool))
    """Contacts of the left and the right toe, at PRIOR_FPS."""
    sources: tuple[GapSource, ...] = ()
    """Proposer of the motion in each gap in which nothing was known."""
    proposal_seconds: float = 0.0
    """Of `seconds`, those in which the in-betweener proposed."""
    pick: Pick | None = None
    """Which of several answers this is; None where one alone was made."""
    gap_notes: tuple[str, ...] = ()
    """A note on each of these gaps: proposer, error estimate, remarks."""

    @property
    def frame_ms(self) -> float:
        """Compute of each filled frame, milliseconds."""
        return 1000 * self.seconds / max(1, int(self.missing.frames.sum()))

    def list_gaps(self) -> list[dict[str, Any]]:
        """List what was filled in: frames, how many joints of the rig, and whether the body's position was missing."""
        joints, root = self.missing.joints, self.missing.root
        return [
            {
                "start": start,
                "stop": stop,
                "joints": int(joints[start:stop].any(dim=0).sum()),
                "root": bool(root[start:stop].any()),
            }
            for _, start, stop in true_intervals(self.missing.frames[:, None])
        ]

    def details(self) -> dict[str, Any]:
        """Return gaps, who filled them, contacts at PRIOR_FPS, and compute of each filled frame.

        `sides_apart_cm` is the farthest at which two sides met, if any did; `fallback` lists gaps, in frames at
        PRIOR_FPS, that were not the in-betweener's that was asked for.
        """
        apart = [100 * source.apart for source in self.sources if source.apart is not None]
        return {
            "gaps": self.list_gaps(),
            "gap_notes": list(self.gap_notes),
            "fallback": [
                {"start": source.start, "stop": source.stop, "by": source.by, "reason": source.reason}
                for source in self.sources
                if source.reason
            ],
            **({"sides_apart_cm": max(apart)} if apart else {}),
            **({"picked": self.pick.name, "draws": dict(self.pick.energies)} if self.pick else {}),
            "timing": {
                "draw_ms": 1000 * self.proposal_seconds,
                "finish_ms": 1000 * (self.seconds - self.proposal_seconds),
            },
            "contacts": self.contacts.tolist(),
            "frame_ms": self.frame_ms,
        }
