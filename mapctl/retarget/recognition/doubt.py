"""One reason to doubt that a rig was understood."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Doubt:
    """A reason to doubt that a rig was understood."""

    reason: str
    """The reason, a sentence without a full stop."""
    joints: tuple[str, ...] = ()
    """Canonical joints that it is about; empty where it is about the whole body."""
