"""Content of one picture, and the protocol of its painter."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

from mapctl.mesh import colours
from mapctl.mesh.mannequin import Mannequin
from mapctl.mesh.primitives import Array, Surface
from scenes.cameras import View


@dataclass(frozen=True, eq=False)
class Figure:
    """One body in one pose."""

    body: Mannequin
    """Body of an actor."""
    frame: int
    """Frame of the actor's own motion."""
    fade: float = 0.0
    """Share of the background in its colours; ghosts have some."""

    def surface(self) -> Surface:
        """Return the body's surface."""
        skin = self.body.surface(self.frame)
        rgba = skin.rgba.copy()
        rgba[:, :3] = colours.blend_colours(rgba[:, :3], colours.rgb(colours.BACKGROUND), self.fade)
        return Surface(skin.vertices, skin.faces, rgba, skin.normals)


@dataclass(frozen=True, eq=False)
class Content:
    """Content of one picture."""

    ground: Sequence[Surface]
    """Flat surfaces in the order in which they cover each other; the figures' shadows fall on them."""
    figures: Sequence[Figure]
    """Bodies above the ground."""


@runtime_checkable
class Painter(Protocol):
    """Turns content into pixels."""

    name: str

    def paint(self, view: View, content: Content) -> Array:
        """Paint (height, width, 3) uint8."""
        ...
