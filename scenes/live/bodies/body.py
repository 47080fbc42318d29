"""What the viewer asks of a body in the browser."""

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np

from mapctl.mesh.primitives import Array
from mapctl.motion import Motion


@dataclass(frozen=True, eq=False)
class BodyPose:
    """A pose, in the terms of the body that it was prepared by."""

    positions: Array
    """(n, 3) of what the body moves, metres."""
    quat_xyzw: Array
    """(n or more, 4) their rotations."""


def blend_poses(first: BodyPose, second: BodyPose, share: float) -> BodyPose:
    """Return the pose between two near ones, `share` of the way (0 to 1) from the first to the second."""
    if share <= 0:
        return first
    same = np.sign((first.quat_xyzw * second.quat_xyzw).sum(axis=-1, keepdims=True))
    quats = (1 - share) * first.quat_xyzw + share * np.where(same == 0, 1, same) * second.quat_xyzw
    return BodyPose(
        (1 - share) * first.positions + share * second.positions, quats / np.linalg.norm(quats, axis=-1, keepdims=True)
    )


@runtime_checkable
class LiveBody(Protocol):
    """A body below a node of the scene."""

    def prepare(self, motion: Motion) -> list[BodyPose]:
        """Prepare the poses of delivered frames, of canonical joints; one each."""
        ...

    def pose(self, pose: BodyPose) -> None:
        """Show a pose."""
        ...
