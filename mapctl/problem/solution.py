"""What a solve returns: the motion, a status whose text is the message, and the ledger of energies and residuals."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from enum import Enum

import torch
from jaxtyping import Float
from torch import Tensor

from mapctl.motion import Motion


class Outcome(Enum):
    """How a solve ended; the value is said to the user."""

    DONE = "done"
    BUDGET = "stopped at its budget"
    INTERRUPTED = "interrupted; what was solved until then is kept"
    INFEASIBLE = "the wishes cannot all hold"
    NOT_FINITE = "stopped where the energy was not finite; the best finite motion is returned"


@dataclass(frozen=True)
class Status:
    """Outcome and, where there is more to say, sentences with numbers."""

    outcome: Outcome
    """How the solve ended."""
    notes: tuple[str, ...] = ()
    """What could not hold, or was assumed; one sentence each."""

    @property
    def text(self) -> str:
        """The message."""
        return "; ".join((self.outcome.value, *self.notes))

    @property
    def ok(self) -> bool:
        """Whether the motion does what was asked."""
        return self.outcome is Outcome.DONE

    def with_notes(self, notes: Sequence[str], *, infeasible: bool = False) -> "Status":
        """The status with more to say; `infeasible` marks wishes that cannot hold."""
        outcome = Outcome.INFEASIBLE if infeasible and self.ok else self.outcome
        return replace(self, outcome=outcome, notes=(*self.notes, *notes))


@dataclass(frozen=True, eq=False)
class LedgerEntry:
    """One term over all frames."""

    name: str
    """The term's name."""
    unit: str
    """Of the residual."""
    energy: Float[Tensor, " frames"]
    """Nats."""
    residual: Float[Tensor, " frames"]
    """How far the wish is missed."""


@dataclass(frozen=True, eq=False)
class Ledger:
    """Energy and physical residual by term and frame."""

    entries: tuple[LedgerEntry, ...] = ()
    """One for each term."""

    def join(self, other: "Ledger") -> "Ledger":
        """This ledger's frames followed by the other's; a term that only one of them lists is 0 in the other's."""
        if not self.entries:
            return other
        mine, theirs = ({entry.name: entry for entry in ledger.entries} for ledger in (self, other))
        return Ledger(tuple(_joined(mine.get(name), theirs.get(name), self, other) for name in mine | theirs))

    def slice(self, frames: int) -> "Ledger":
        """The first frames."""
        return Ledger(tuple(replace(e, energy=e.energy[:frames], residual=e.residual[:frames]) for e in self.entries))

    def summary(self) -> dict[str, dict[str, float | str]]:
        """For a report: by term the total energy, and mean, 95th percentile and maximum of the residual."""
        return {
            entry.name: {
                "energy_nats": float(entry.energy.sum()),
                "residual_unit": entry.unit,
                "residual_mean": float(entry.residual.mean()),
                "residual_p95": float(torch.quantile(entry.residual.double(), 0.95)),
                "residual_max": float(entry.residual.max()),
            }
            for entry in self.entries
        }


def _joined(before: LedgerEntry | None, after: LedgerEntry | None, first: Ledger, second: Ledger) -> LedgerEntry:
    """One term of two ledgers, of which one may not have it."""
    some = before or after
    assert some is not None, "the term comes from one of them"
    nothing = [torch.zeros_like(ledger.entries[0].energy) for ledger in (first, second)]
    sides = zip((before, after), nothing, strict=True)
    energies, residuals = zip(*((e.energy, e.residual) if e else (zero, zero) for e, zero in sides), strict=True)
    return LedgerEntry(some.name, some.unit, torch.cat(energies), torch.cat(residuals))


@dataclass(frozen=True)
class WindowRecord:
    """What one window cost."""

    frames: int
    """Frames it committed."""
    seconds: float
    """Compute, wall clock."""
    evaluations: int
    """Energy-and-gradient evaluations, counted a candidate."""
    start_energy: float
    """Nats before the solve."""
    energy: float
    """Nats after it."""
    outcome: str
    """Why L-BFGS stopped."""


@dataclass(frozen=True, eq=False)
class Solution:
    """A finished (or best so far) motion and how it came about."""

    motion: Motion
    """The result."""
    status: Status
    """Why it ended, in words."""
    ledger: Ledger
    """By term and frame."""
    windows: tuple[WindowRecord, ...] = ()
    """Cost of each window."""
    features: Float[Tensor, "frames size"] | None = field(default=None, repr=False)
    """The motion as the prior's features."""
