"""Solution of a MAP problem: the motion, a status whose text is the message, and the ledger of energies and
residuals."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import Enum
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from mapctl.motion import Motion
from mapctl.problem.density_selection import DensityChoice


@dataclass(frozen=True, eq=False)
class LedgerEntry:
    """Energy and residual of one term, frame by frame."""

    name: str
    """Name of the term."""
    unit: str
    """Unit of the residual."""
    energy: Float[Tensor, " frames"]
    """Energy of each frame, nats."""
    residual: Float[Tensor, " frames"]
    """Distance of each frame from what the term wants, in `unit`."""


@dataclass(frozen=True, eq=False, repr=False)
class Ledger:
    """Energy and physical residual by term and frame."""

    entries: tuple[LedgerEntry, ...] = ()
    """Entries, one a term."""

    def __str__(self) -> str:
        means = [f"{entry.name} {float(entry.residual.mean()):.2g} {entry.unit}" for entry in self.entries]
        return f"Ledger: {', '.join(means) or 'no terms'}"

    def __repr__(self) -> str:
        return f"<{self}>"

    def join(self, other: "Ledger") -> "Ledger":
        """Join this ledger's frames with the other's after them; a term that one of them lacks is 0 there."""
        if not self.entries:
            return other
        mine, theirs = ({entry.name: entry for entry in ledger.entries} for ledger in (self, other))
        return Ledger(tuple(_join_entries(mine.get(name), theirs.get(name), self, other) for name in mine | theirs))

    def pick(self, frames: slice) -> "Ledger":
        """Return the ledger of some frames."""
        return Ledger(tuple(replace(e, energy=e.energy[frames], residual=e.residual[frames]) for e in self.entries))

    def summary(self) -> dict[str, dict[str, float | str]]:
        """Summarise for a report: by term the total energy, and mean, 95th percentile and maximum of the residual."""
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


def _join_entries(before: LedgerEntry | None, after: LedgerEntry | None, first: Ledger, second: Ledger) -> LedgerEntry:
    """Join one term of two ledgers, of which one may lack it."""
    some = before or after
    assert some is not None, "the term comes from one of them"
    nothing = [torch.zeros_like(ledger.entries[0].energy) for ledger in (first, second)]
    sides = zip((before, after), nothing, strict=True)
    energies, residuals = zip(*((e.energy, e.residual) if e else (zero, zero) for e, zero in sides), strict=True)
    return LedgerEntry(some.name, some.unit, torch.cat(energies), torch.cat(residuals))


class Outcome(Enum):
    """How a solve ended; the value is its message."""

    DONE = "done"
    BUDGET = "stopped at its budget"
    INTERRUPTED = "interrupted; what was solved until then is kept"
    INFEASIBLE = "the constraints cannot all hold"
    OUT_OF_DEPTH = "outside the model's training data"
    NOT_FINITE = "stopped where the energy was not finite; the best finite motion is returned"


@dataclass(frozen=True)
class Status:
    """Outcome and, where needed, sentences with numbers."""

    outcome: Outcome
    """How the solve ended."""
    notes: tuple[str, ...] = ()
    """Constraints that could not hold, and assumptions; one sentence each."""

    @property
    def text(self) -> str:
        """The message."""
        return "; ".join((self.outcome.value, *self.notes))

    @property
    def ok(self) -> bool:
        """Whether the motion does what was asked."""
        return self.outcome is Outcome.DONE

    def with_notes(self, notes: Sequence[str], *, infeasible: bool = False) -> "Status":
        """Return the status with further sentences; `infeasible` marks constraints that cannot hold."""
        outcome = Outcome.INFEASIBLE if infeasible and self.ok else self.outcome
        return replace(self, outcome=outcome, notes=(*self.notes, *notes))


@dataclass(frozen=True)
class WindowRecord:
    """Cost of one window."""

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
    choice: DensityChoice | None = None
    """Which of several densities scored it, where there were several to choose from."""


@dataclass(frozen=True, eq=False, repr=False)
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
    features: Float[Tensor, "frames size"] | None = None
    """The motion as the prior's features."""
    seconds: float = 0.0
    """Compute, wall clock."""

    def __str__(self) -> str:
        residuals = [f"mean residuals: {str(self.ledger).partition(': ')[2]}"] if self.ledger.entries else []
        took = f"{self.motion.describe()}; took {self.seconds:.2g} s"
        return "\n".join([f"{type(self).__name__}: {self.status.outcome.value}", took, *residuals, *self.notes])

    def __repr__(self) -> str:
        return f"<{type(self).__name__}: {self.status.outcome.value}; {self.motion.describe()}>"

    @property
    def notes(self) -> tuple[str, ...]:
        """Remarks for the user, one sentence each."""
        return self.status.notes

    def details(self) -> dict[str, Any]:
        """Return what a report shows of this job beyond motion, status, ledger and timing, in plain numbers."""
        return {}
