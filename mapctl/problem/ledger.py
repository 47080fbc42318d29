"""The ledger of a solve: energy and physical residual by term and frame."""

import builtins
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor


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

    def slice(self, frames: int) -> "Ledger":
        """Return the ledger of the first frames."""
        return self.pick(builtins.slice(frames))

    def pick(self, frames: builtins.slice) -> "Ledger":
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
