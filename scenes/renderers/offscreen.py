"""Pictures by pyrender: on Linux without a window (EGL), in software where there is no graphics card; on other systems
in a window that is not shown, which needs a screen."""

import os
import sys
from collections.abc import Mapping
from functools import cache
from types import ModuleType
from typing import Any

import numpy as np

from mapctl.errors import MapctlError
from mapctl.mesh import colours
from mapctl.mesh.primitives import Array, Surface
from scenes.cameras import View
from scenes.content import Content, blend_veils
from scenes.overlays import build_shadow
from scenes.renderers.layers import Layer, list_layers

NEEDS_NO_SCREEN = sys.platform == "linux"
"""Whether EGL draws. macOS and Windows have none of their own."""
_NEAR, _FAR = 0.3, 400.0


class NoGraphicsError(MapctlError):
    """OpenGL cannot be used here; the message says what is missing."""


class OffscreenPainter:
    """Paints shaded bodies on the ground. Raises NoGraphicsError where there is no OpenGL."""

    name = "pyrender (EGL)" if NEEDS_NO_SCREEN else "pyrender (hidden window)"

    def __init__(self):
        self._gl, self._renderer = _open_graphics()
        gl = self._gl
        self._scene = gl.Scene(bg_color=[*colours.rgb(colours.BACKGROUND), 1.0])
        self._camera = self._scene.add(gl.PerspectiveCamera(yfov=1.0, znear=_NEAR, zfar=_FAR))
        looks = {
            Layer.CLOSED: {},
            Layer.OPEN: {"doubleSided": True},
            Layer.SHEER: {"doubleSided": True, "alphaMode": "BLEND"},
        }
        self._looks = {
            layer: gl.MetallicRoughnessMaterial(baseColorFactor=[1.0] * 4, **look) for layer, look in looks.items()
        }

    def paint(self, view: View, content: Content) -> Array:
        """Paint the picture, (height, width, 3) uint8."""
        eye = view.pose[:3, 3]
        shadows = [build_shadow(*f.body.sticks(f.frame)[:2], layer=k) for k, f in enumerate(content.figures)]
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

    def _add(self, layers: Mapping[Layer, Surface]) -> list[Any]:
        """Add each layer as one mesh: a draw call costs more than a body's triangles, and the order stays."""
        nodes = []
        for layer, surface in layers.items():
            primitive = self._gl.Primitive(
                positions=surface.vertices, indices=surface.faces, color_0=surface.rgba, material=self._looks[layer]
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
    except _list_graphics_errors() as error:
        reason = str(error).strip().splitlines()[0] if str(error).strip() else type(error).__name__
        raise NoGraphicsError(f"no OpenGL without a window ({reason})") from error


def _list_graphics_errors() -> tuple[type[Exception], ...]:
    """List what a missing library, driver or display raises somewhere between Python and EGL; of windows, anything."""
    if not NEEDS_NO_SCREEN:
        return (Exception,)  # each windowing system has errors of its own
    plain = (ImportError, OSError, AttributeError, AssertionError, ValueError, RuntimeError, TypeError)
    own = getattr(sys.modules.get("OpenGL.error"), "Error", None)  # nobody raises it before it is imported
    return plain if own is None else (*plain, own)
