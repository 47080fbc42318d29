"""The body of one actor over a whole motion, as whoever paints it sees it."""

from typing import Protocol, runtime_checkable

from mapctl.mesh.anatomy import Anatomy
from mapctl.mesh.primitives import Array, Surface


@runtime_checkable
class Body(Protocol):
    """A mannequin, or a character with a mesh of its own."""

    @property
    def anatomy(self) -> Anatomy:
        """Hips, head and soles."""
        ...

    @property
    def num_frames(self) -> int:
        """Frames of the motion."""
        ...

    @property
    def seen(self) -> Array:
        """Positions (frames, n, 3) between which the body is, about, metres; without a root on the floor."""
        ...

    def surface(self, frame: int) -> Surface:
        """Return the lit surface in one frame."""
        ...

    def sticks(self, frame: int) -> tuple[Array, Array, Array]:
        """Return all bones in one frame: ends (n, 2, 3) and radii (n,) in metres, colours (n, 3) sRGB."""
        ...
