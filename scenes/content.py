"""Content of one picture, and the protocol of its painter."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Protocol, runtime_checkable

import numpy as np

from mapctl.mesh import colours
from mapctl.mesh.body import Body
from mapctl.mesh.primitives import Array, Surface
from scenes.cameras import View

_VEIL_OPACITY = 0.4


@dataclass(frozen=True, eq=False)
class Figure:
    """One body in one pose."""

    body: Body
    """Body of an actor."""
    frame: int
    """Frame of the actor's own motion."""
    fade: float = 0.0
    """Share of another colour in its own; ghosts have some."""
    toward: str = colours.BACKGROUND
    """That colour, `#rrggbb`."""
    shell: float = 0.0
    """Metres by which its surface is around the body's, so that it covers the same body in the same pose."""

    def surface(self) -> Surface:
        """Return the body's surface."""
        skin = self.body.surface(self.frame)
        assert skin.normals is not None, "bodies are lit"
        rgba = np.column_stack([self.tint(skin.rgba[:, :3]), skin.rgba[:, 3]])
        return replace(skin, vertices=skin.vertices + self.shell * skin.normals, rgba=rgba)

    def tint(self, rgb: Array) -> Array:
        """Return colours of the body (n, 3) as they are shown."""
        return colours.blend_colours(rgb, colours.rgb(self.toward), self.fade)


@dataclass(frozen=True, eq=False)
class Content:
    """Content of one picture."""

    ground: Sequence[Surface]
    """Flat surfaces in the order in which they cover each other; the figures' shadows fall on them."""
    figures: Sequence[Figure]
    """Bodies above the ground."""
    veils: Sequence[Figure] = ()
    """Bodies that one sees through (see `blend_veils`); they throw no shadow."""


def blend_veils(plain: Array, covered: Array) -> Array:
    """Blend a picture without veils and one in which they are opaque, both (height, width, 3) uint8.

    Triangles and lines that are blended one by one would show what is within a body.
    """
    return np.rint(colours.blend_colours(plain.astype(np.float32), covered, _VEIL_OPACITY)).astype(np.uint8)


@runtime_checkable
class Painter(Protocol):
    """Turns content into pixels."""

    name: str

    def paint(self, view: View, content: Content) -> Array:
        """Paint (height, width, 3) uint8."""
        ...
