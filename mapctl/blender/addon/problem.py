"""What the interface tells the user: reasons why an operator cannot do what it should, and how far it is."""

from typing import NamedTuple


class AddonError(Exception):
    """A reason, in one line, why nothing was changed, and what can be done about it."""


class Step(NamedTuple):
    """How far a job is."""

    label: str
    """What is being done."""
    done: int = 0
    """Work done."""
    total: int = 0
    """Work in all; 0 where that is not known."""
    idle: bool = False
    """Whether the job waits for another process, so that asking again at once leads nowhere."""

    def describe(self) -> str:
        """Describe it in a few words."""
        return f"{self.label} {100 * self.done // self.total} %" if self.total else self.label
