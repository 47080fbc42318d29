"""What a scene shows beside actors: obstacles, and what is to be reached, looked at and stood on."""

import numpy as np

from mapctl.curves.obstacles import Obstacle
from mapctl.mesh import colours
from mapctl.mesh.primitives import Array, Surface, merge_surfaces, unit_sphere
from scenes import overlays

_OBSTACLE_COLOUR = "#b9aa9c"
_HEIGHT, _SHADE = 0.35, 0.82  # metres of an obstacle's walls, and how dark they are beside its top
_TARGET_RADIUS, _LOOK_RADIUS, _PLACE_RADIUS = 0.035, 0.05, 0.16  # metres


def build_obstacle(obstacle: Obstacle) -> Surface:
    """Build a low solid on the ground with the obstacle's outline."""
    outline = obstacle.outline().numpy()
    count = len(outline)
    low, high = (np.insert(outline, 1, height, axis=1) for height in (0.0, _HEIGHT))
    index = np.arange(count)
    following = np.roll(index, -1)
    walls = np.stack([index, following, following + count, index + count], axis=1)
    walls = np.concatenate([walls[:, [0, 1, 2]], walls[:, [0, 2, 3]]])
    fan = np.stack([np.zeros(count - 2, int), index[1:-1], index[2:]], axis=1) + 2 * count
    top = colours.rgb(_OBSTACLE_COLOUR)
    rgb = np.concatenate([np.tile(_SHADE * top, (2 * count, 1)), np.tile(top, (count, 1))])
    return _make_flat(
        np.concatenate([low, high, high]), np.concatenate([walls, walls[:, ::-1], fan, fan[:, ::-1]]), rgb
    )


def build_target(place: tuple[float, float, float]) -> Surface:
    """Build a small ball at a place (x, y, z), metres, that a hand or a foot is to reach."""
    vertices, faces = unit_sphere()
    return _make_plain(_TARGET_RADIUS * vertices + np.array(place), faces)


def build_look_mark(place: tuple[float, float, float]) -> Surface:
    """Build a small octahedron at a place to be looked at."""
    axes = np.concatenate([np.eye(3), -np.eye(3)])
    faces = np.array([[x, y, z] for x in (0, 3) for y in (1, 4) for z in (2, 5)])
    return _make_plain(_LOOK_RADIUS * axes + np.array(place), faces)


def build_hips_mark(place: Array, heading: float | None) -> Surface:
    """Build a disc on the ground where hips are to be, (x, z) metres, with an arrow to where they are to face, radians
    from +Z toward +X; without one where they may face anywhere."""
    rgb = colours.rgb(colours.TARGET)
    disc = overlays.build_discs(place[None], rgb[None], radius=_PLACE_RADIUS)
    if heading is None:
        return disc
    return merge_surfaces([disc, overlays.build_arrow(place, heading, rgb, length=3 * _PLACE_RADIUS)])


def _make_plain(vertices: Array, faces: Array) -> Surface:
    """Make a surface in the colour of all that is asked for."""
    return _make_flat(vertices, faces, np.tile(colours.rgb(colours.TARGET), (len(vertices), 1)))


def _make_flat(vertices: Array, faces: Array, rgb: Array) -> Surface:
    return Surface(vertices, faces, np.concatenate([rgb, np.ones((len(rgb), 1))], axis=1))
