"""Choice of a painter: shaded bodies where OpenGL works, stick figures where it does not.

Stick figures by matplotlib, for machines without OpenGL: the same cameras, ground and colours.

Imported late, where they are needed: matplotlib may not be installed.
"""

import logging
import os
from typing import Any, Literal

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.figure import Figure as Sheet

from mapctl.errors import RequestError
from mapctl.mesh import colours
from mapctl.mesh.primitives import Array, Surface
from scenes.cameras import View
from scenes.content import Content, Figure, Painter, blend_veils
from scenes.overlays import LIGHT
from scenes.renderers import STICK_FIGURES
from scenes.renderers.offscreen import NEEDS_NO_SCREEN, NoGraphicsError, OffscreenPainter

RendererName = Literal["auto", "egl", "stick"]
RENDERER_VARIABLE = "MAPCTL_RENDERER"
"""Environment variable with the renderer where none is asked for."""

_PACKAGES = "libegl1 libgl1 libgl1-mesa-dri libgles2"
_log = logging.getLogger("mapctl.scenes")


def select_painter(name: RendererName | None = None) -> Painter:
    """Select the painter of a name; None takes the one in MAPCTL_RENDERER, else `auto`.

    `auto` falls back to stick figures and logs one line that says what is missing; `egl` raises NoGraphicsError.
    RequestError for other names, and where not even matplotlib is installed.
    """
    wanted = name or os.environ.get(RENDERER_VARIABLE) or "auto"
    if wanted not in ("auto", "egl", "stick"):
        raise RequestError(f"the renderer must be auto, egl or stick, got {wanted!r}")
    if wanted == "stick":
        return _make_stick_painter()
    try:
        return OffscreenPainter()
    except NoGraphicsError as error:
        if wanted == "egl":
            raise
        _log.warning("%s; drawing stick figures. %s", error, _advise(error))
        return _make_stick_painter()


def back_end() -> str:
    """Describe in one line what films would be made with here, and why not better."""
    try:
        return select_painter("egl").name
    except NoGraphicsError as error:
        return f"{STICK_FIGURES}: {error}"


def _advise(error: NoGraphicsError) -> str:
    """Say what to install."""
    if isinstance(error.__cause__, ModuleNotFoundError):
        return "For shaded bodies: pip install 'mapctl[render]'"
    return f"On Debian: apt-get install {_PACKAGES}" if NEEDS_NO_SCREEN else "For shaded bodies: a screen is needed"


def _make_stick_painter() -> Painter:
    try:
        from scenes.renderers.select import StickPainter
    except ImportError as error:
        raise RequestError(f"films need matplotlib or pyrender ({error}): pip install 'mapctl[render]'") from error
    return StickPainter()


_NEAR = 0.1
"""Nothing closer to the camera than this is drawn, metres."""
_DPI = 100
_THICKNESS = 1.3
"""Width of a stick, in radii of the body part; 2 would be as thick as the body."""
_SHADOW_STRENGTH = 0.12


class StickPainter:
    """Paints bones as thick lines."""

    name = STICK_FIGURES

    def __init__(self):
        self._sheet = Sheet(dpi=_DPI, facecolor=colours.BACKGROUND)
        self._canvas = FigureCanvasAgg(self._sheet)

    def paint(self, view: View, content: Content) -> Array:
        """Paint the picture, (height, width, 3) uint8."""
        self._sheet.clear()
        self._sheet.set_size_inches(view.width / _DPI, view.height / _DPI)
        axes = self._sheet.add_axes((0, 0, 1, 1))
        axes.set_axis_off()
        axes.set(xlim=(0, view.width), ylim=(view.height, 0))
        for surface in content.ground:
            _draw_flat(axes, view, surface)
        for figure in content.figures:
            _draw_shadow(axes, view, figure)
        for figure in content.figures:
            _draw_figure(axes, view, figure)
        picture = self._shoot(view)
        if not content.veils:
            return picture
        for figure in content.veils:
            _draw_figure(axes, view, figure)
        return blend_veils(picture, self._shoot(view))

    def _shoot(self, view: View) -> Array:
        self._canvas.draw()
        return np.asarray(self._canvas.buffer_rgba())[: view.height, : view.width, :3].copy()


def _draw_flat(axes, view: View, surface: Surface) -> None:
    corners = view.project(surface.vertices)[surface.faces]
    rgba = surface.rgba[surface.faces].mean(axis=1)
    shown = (corners[..., 2] > _NEAR).all(axis=1) & (rgba[:, 3] > 0.02)
    # One array is several times faster than a list of triangles; with antialiasing these would show their seams.
    triangles: Any = corners[shown, :, :2]
    axes.add_collection(PolyCollection(triangles, facecolors=rgba[shown], linewidths=0, antialiaseds=False))


def _draw_shadow(axes, view: View, figure: Figure) -> None:
    """Draw the sticks laid on the ground along the light."""
    ends, radii, _ = figure.body.sticks(figure.frame)
    fallen = ends - ends[..., 1:2] * (LIGHT / LIGHT[1])
    shade = np.tile([*colours.rgb(colours.SHADOW), _SHADOW_STRENGTH], (len(ends), 1))
    _draw_lines(axes, view, fallen, radii, shade)


def _draw_figure(axes, view: View, figure: Figure) -> None:
    ends, radii, rgb = figure.body.sticks(figure.frame)
    _draw_lines(axes, view, ends, radii + figure.shell, figure.tint(rgb))


def _draw_lines(axes, view: View, ends: Array, radii: Array, shown: Array) -> None:
    """Draw lines (n, 2, 3) in the world as thick as the body there, the furthest first."""
    flat = view.project(ends)
    depth = flat[..., 2].mean(axis=1)
    order = np.argsort(-depth)
    order = order[(flat[order, :, 2] > _NEAR).all(axis=1)]
    focal = view.height / 2 / np.tan(view.fov / 2)
    points = np.maximum(1.0, _THICKNESS * radii * focal / np.maximum(depth, _NEAR)) * 72 / _DPI
    lines = list(flat[order, :, :2])
    axes.add_collection(LineCollection(lines, linewidths=points[order], colors=shown[order], capstyle="round"))
