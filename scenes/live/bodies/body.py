"""What the viewer asks of a body in the browser."""

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

from mapctl.mesh.primitives import Array
from mapctl.motion import Motion


@dataclass(frozen=True, eq=False)
class BodyPose:
    """A pose, in the terms of the body that it was prepared by."""

    positions: Array
    """(n, 3) of what the body moves, metres."""
    quat_xyzw: Array
    """(n or more, 4) their rotations."""


@runtime_checkable
class LiveBody(Protocol):
    """A body below a node of the scene."""

    def prepare(self, motion: Motion) -> list[BodyPose]:
        """Prepare the poses of delivered frames, of canonical joints; one each."""
        ...

    def pose(self, pose: BodyPose) -> None:
        """Show a pose."""
        ...
