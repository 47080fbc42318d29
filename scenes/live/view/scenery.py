"""Ground, sky and light of the live viewer, in the colours of a theme."""

import math

import numpy as np
import viser

from mapctl.mesh import colours
from mapctl.mesh.primitives import Array
from scenes.live.ground import to_rgb_bytes
from scenes.live.view.themes import Theme
from scenes.overlays import LIGHT

_LAMP_METRES = 20.0  # from the origin; the direction alone matters
_FADE_METRES, _SECTION_METRES = 30.0, 5.0
_BRAND = (38, 98, 184)  # of buttons, dark enough for white letters
_SKY_ROWS, _SKY_END = 256, 0.55  # rows of the picture behind all; share of its height at which it is the horizon's


class Scenery:
    """Ground below the node `world`, and a lamp that turns with it but does not travel: its place is its direction."""

    def __init__(self, server: viser.ViserServer, world: str, theme: Theme):
        """Add all in the colours of a theme."""
        self._server = server
        scene = server.scene
        scene.configure_default_lights(enabled=False)
        self._lamp = scene.add_frame("/lamp", show_axes=False)
        self._key = scene.add_light_directional("/lamp/key", cast_shadow=True, position=tuple(-_LAMP_METRES * LIGHT))
        self._fill = scene.add_light_hemisphere("/sky", sky_color=(236, 242, 255), ground_color=(150, 146, 140))
        self._floor = scene.add_grid(
            f"{world}/floor",
            plane="xz",
            infinite_grid=True,
            cell_size=1.0,
            section_size=_SECTION_METRES,
            cell_thickness=0.9,
            section_thickness=1.6,
            fade_distance=_FADE_METRES,
            plane_opacity=1.0,
        )
        self.set_theme(theme)

    def set_theme(self, theme: Theme) -> None:
        """Change all colours, those of the panel too."""
        self._server.gui.configure_theme(
            dark_mode=theme.dark, show_logo=False, show_share_button=False, brand_color=_BRAND
        )
        self._server.scene.configure_environment_map("studio", environment_intensity=theme.fill)
        self._server.scene.set_background_image(paint_sky(theme), format="png")
        self._key.intensity, self._fill.intensity = theme.key, theme.fill
        floor = self._floor
        floor.plane_color, floor.shadow_opacity = to_rgb_bytes(theme.floor), theme.shadow
        floor.cell_color, floor.section_color = to_rgb_bytes(theme.line), to_rgb_bytes(theme.strong_line)

    def turn(self, yaw: float) -> None:
        """Turn the lamp with the world, radians about +Y."""
        self._lamp.wxyz = (math.cos(yaw / 2), 0.0, math.sin(yaw / 2), 0.0)


def paint_sky(theme: Theme) -> Array:
    """Paint the picture behind all (rows, 2, 3) uint8: overhead's colour on top, from the middle on the horizon's."""
    share = np.clip(np.linspace(0, 1, _SKY_ROWS) / _SKY_END, 0, 1)
    share = (share * share * (3 - 2 * share))[:, None]
    rows = colours.blend_colours(colours.rgb(theme.zenith), colours.rgb(theme.horizon), share)
    return np.repeat((255 * rows).round().astype(np.uint8)[:, None], 2, axis=1)
