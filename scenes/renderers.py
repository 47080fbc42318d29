"""Painters of pictures: shaded bodies where OpenGL works, stick figures by matplotlib where it does not.

pyrender draws without a window on Linux (EGL), in software where there is no graphics card; on other systems in a
window that is not shown, which needs a screen. Light is computed at vertices, the same in every renderer, and cheap
where pixels are slow: a soft key lamp with a wide highlight, light from the sky and a little back from the floor, and a
thin bright rim that lifts a figure off the ground. All in linear light; sRGB in and out (gamma 2.2).
"""

import logging
import os
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from types import ModuleType
from typing import Any, Literal

import numpy as np

from mapctl.errors import MapctlError, RequestError
from mapctl.ground import Ground
from mapctl.mesh import colours
from mapctl.mesh.mannequin import Body
from mapctl.mesh.primitives import Array, Surface, merge_surfaces, unit
from scenes.cameras import View
from scenes.overlays import LIGHT, build_shadow, drape, raise_onto

STICK_FIGURES = "matplotlib (stick figures)"
"""Name of the painter that works everywhere; its module needs matplotlib."""


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
    veils: Sequence[Figure] = ()
    """Bodies that one sees through (see `blend_veils`); they throw no shadow."""
    terrain: Ground | None = None
    """Ground on which the shadows fall where it is not flat."""


def blend_veils(plain: Array, covered: Array) -> Array:
    """Blend a picture without veils and one in which they are opaque, both (height, width, 3) uint8.

    Triangles and lines that are blended one by one would show what is within a body.
    """
    return np.rint(colours.blend_colours(plain.astype(np.float32), covered, _VEIL_OPACITY)).astype(np.uint8)


_OPAQUE = 0.999
_KEY, _WRAP = 0.78, 0.25
_SKY, _FLOOR = np.array([0.40, 0.42, 0.46]), np.array([0.20, 0.19, 0.18])
_HIGHLIGHT, _SHARPNESS = 0.16, 22.0
_RIM = 0.10
_GAMMA = 2.2


def list_layers(ground: Sequence[Surface], bodies: Sequence[Surface], eye: Array) -> list[Surface | None]:
    """List what is opaque, from both sides, and what is seen through, in the order of its faces, shaded as seen from
    `eye` (3,): the ground, and over it the triangles of bodies that are not opaque, the furthest first. None for what
    has no triangles."""
    solid, sheer = list[Surface](), [shade(surface, eye) for surface in ground]
    for body in (shade(one, eye) for one in bodies):
        # Vertices of opaque triangles have no opacity, by which a mesh as a whole would count as seen through.
        opaque = replace(body, rgba=np.column_stack([body.rgba[:, :3], np.ones(len(body.rgba))]))
        is_sheer = (body.rgba[body.faces, 3] < _OPAQUE).any(axis=1)
        solid.append(replace(opaque, faces=body.faces[~is_sheer]))
        faces = body.faces[is_sheer]
        away = np.linalg.norm(body.vertices[faces].mean(axis=1) - eye, axis=1)
        sheer.append(replace(body, faces=faces[np.argsort(-away)]))
    merged = [merge_surfaces(surfaces) if surfaces else None for surfaces in (solid, sheer)]
    return [surface if surface is not None and len(surface.faces) else None for surface in merged]


def shade(surface: Surface, eye: Array) -> Surface:
    """Put the light into the colours (n, 4) of a lit surface as seen from `eye` (3,); a flat one keeps its colours."""
    if surface.normals is None:
        return surface
    normals, to_eye = surface.normals, unit(eye - surface.vertices)
    towards_lamp = -LIGHT
    facing = normals @ towards_lamp
    key = _KEY * np.clip((facing + _WRAP) / (1 + _WRAP), 0, None)
    sky = (normals[:, 1:2] + 1) / 2
    light = key[:, None] + _FLOOR + (_SKY - _FLOOR) * sky
    halfway = unit(to_eye + towards_lamp)
    shine = _HIGHLIGHT * np.clip(np.einsum("ij,ij->i", normals, halfway), 0, None) ** _SHARPNESS * (facing > 0)
    rim = _RIM * (1 - np.clip(np.einsum("ij,ij->i", normals, to_eye), 0, 1)) ** 3 * sky[:, 0]
    linear = surface.rgba[:, :3] ** _GAMMA * light + (shine + rim)[:, None]
    rgba = np.column_stack([np.clip(linear, 0, 1) ** (1 / _GAMMA), surface.rgba[:, 3]])
    return replace(surface, rgba=rgba, normals=None)


NEEDS_NO_SCREEN = sys.platform == "linux"
"""Whether EGL draws. macOS and Windows have none of their own."""
_CLIP_NEAR, _CLIP_FAR = 0.3, 400.0


class NoGraphicsError(MapctlError):
    """OpenGL cannot be used here; the message names what is missing."""


class OffscreenPainter:
    """Paints shaded bodies on the ground. Raises NoGraphicsError where there is no OpenGL."""

    name = "pyrender (EGL)" if NEEDS_NO_SCREEN else "pyrender (hidden window)"

    def __init__(self):
        self._gl, self._renderer = _open_graphics()
        gl = self._gl
        self._scene = gl.Scene(bg_color=[*colours.rgb(colours.BACKGROUND), 1.0])
        self._camera = self._scene.add(gl.PerspectiveCamera(yfov=1.0, znear=_CLIP_NEAR, zfar=_CLIP_FAR))
        self._looks = [
            gl.MetallicRoughnessMaterial(baseColorFactor=[1.0] * 4, doubleSided=True, alphaMode=mode)
            for mode in ("OPAQUE", "BLEND")
        ]

    def paint(self, view: View, content: Content) -> Array:
        """Paint the picture, (height, width, 3) uint8."""
        eye = view.pose[:3, 3]
        shadows = [
            drape(build_shadow(raise_onto(ends, content.terrain, -1), radii, layer=k), content.terrain)
            for k, (ends, radii, _) in enumerate(f.body.sticks(f.frame) for f in content.figures)
        ]
        nodes = self._add(list_layers([*content.ground, *shadows], [f.surface() for f in content.figures], eye))
        camera = self._camera.camera
        camera.yfov, camera.aspectRatio = view.fov, view.width / view.height
        self._scene.set_pose(self._camera, view.pose)
        self._renderer.viewport_width, self._renderer.viewport_height = view.width, view.height
        picture, _ = self._renderer.render(self._scene, self._gl.RenderFlags.FLAT)
        if content.veils:
            nodes += self._add(list_layers([], [figure.surface() for figure in content.veils], eye))
            picture = blend_veils(picture, self._renderer.render(self._scene, self._gl.RenderFlags.FLAT)[0])
        for node in nodes:
            self._scene.remove_node(node)
        return picture

    def _add(self, layers: Sequence[Surface | None]) -> list[Any]:
        """Add each layer as one mesh: a draw call costs more than a body's triangles, and the order stays."""
        nodes = []
        for surface, look in zip(layers, self._looks, strict=True):
            if surface is not None:
                primitive = self._gl.Primitive(
                    positions=surface.vertices, indices=surface.faces, color_0=surface.rgba, material=look
                )
                nodes.append(self._scene.add(self._gl.Mesh([primitive])))
        return nodes


@cache
def _open_graphics() -> tuple[ModuleType, Any]:
    """Open pyrender and its one renderer. Deleting one cuts off all others, so none is deleted and none added."""
    if NEEDS_NO_SCREEN:
        os.environ.setdefault("PYOPENGL_PLATFORM", "egl")
    if not hasattr(np, "infty"):
        setattr(np, "infty", np.inf)  # noqa: B010 - pyrender 0.1.45 asks numpy 2 for what it dropped
    try:
        import pyrender

        return pyrender, pyrender.OffscreenRenderer(64, 64)
    except Exception as error:  # a missing library, driver or display raises anything between Python and EGL
        reason = str(error).strip().splitlines()[0] if str(error).strip() else type(error).__name__
        raise NoGraphicsError(f"no OpenGL without a window ({reason})") from error


RENDERER_VARIABLE = "MAPCTL_RENDERER"
"""Environment variable with the renderer where none is requested."""

_ADVICE = "For shaded bodies: pip install 'mapctl[render]', and on Debian apt-get install libegl1 libgl1-mesa-dri"
_log = logging.getLogger("mapctl.scenes")


def select_painter(name: Literal["auto", "egl", "stick"] | None = None) -> "Painter":
    """Select the painter of a name; None takes the one in MAPCTL_RENDERER, else `auto`.

    `auto` falls back to stick figures and logs one line on what is missing; `egl` raises NoGraphicsError.
    RequestError for other names, and where not even matplotlib is installed.
    """
    wanted = name or os.environ.get(RENDERER_VARIABLE) or "auto"
    if wanted not in ("auto", "egl", "stick"):
        raise RequestError(f"the renderer must be auto, egl or stick, got {wanted!r}")
    if wanted != "stick":
        try:
            return OffscreenPainter()
        except NoGraphicsError as error:
            if wanted == "egl":
                raise
            _log.warning("%s; drawing stick figures. %s", error, _ADVICE)
    try:
        return StickPainter()
    except ImportError as error:
        raise RequestError(f"films need matplotlib or pyrender ({error}): pip install 'mapctl[render]'") from error


def back_end() -> str:
    """Describe in one line what films would be made with here, and why not better."""
    try:
        return select_painter("egl").name
    except NoGraphicsError as error:
        return f"{STICK_FIGURES}: {error}"


_NEAR = 0.1
"""Nothing closer to the camera than this is drawn, metres."""
_DPI = 100
_THICKNESS = 1.3
"""Width of a stick, in radii of the body part; 2 would be as thick as the body."""


class StickPainter:
    """Paints bones as thick lines."""

    name = STICK_FIGURES

    def __init__(self):
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure as Sheet

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
        for figure in (*content.veils, *content.figures):
            ends, radii, rgb = figure.body.sticks(figure.frame)
            _draw_lines(axes, view, ends, radii, figure.tint(rgb))
        self._canvas.draw()
        return np.asarray(self._canvas.buffer_rgba())[: view.height, : view.width, :3].copy()


Painter = OffscreenPainter | StickPainter
"""What turns content into pixels."""


def _draw_flat(axes, view: View, surface: Surface) -> None:
    from matplotlib.collections import PolyCollection

    corners = view.project(surface.vertices)[surface.faces]
    rgba = surface.rgba[surface.faces].mean(axis=1)
    shown = (corners[..., 2] > _NEAR).all(axis=1) & (rgba[:, 3] > 0.02)
    # One array is several times faster than a list of triangles; with antialiasing these would show their seams.
    triangles: Any = corners[shown, :, :2]
    axes.add_collection(PolyCollection(triangles, facecolors=rgba[shown], linewidths=0, antialiaseds=False))


def _draw_lines(axes, view: View, ends: Array, radii: Array, shown: Array) -> None:
    """Draw lines (n, 2, 3) in the world as thick as the body there, the furthest first."""
    from matplotlib.collections import LineCollection

    flat = view.project(ends)
    depth = flat[..., 2].mean(axis=1)
    order = np.argsort(-depth)
    order = order[(flat[order, :, 2] > _NEAR).all(axis=1)]
    focal = view.height / 2 / np.tan(view.fov / 2)
    points = np.maximum(1.0, _THICKNESS * radii * focal / np.maximum(depth, _NEAR)) * 72 / _DPI
    lines = list(flat[order, :, :2])
    axes.add_collection(LineCollection(lines, linewidths=points[order], colors=shown[order], capstyle="round"))
