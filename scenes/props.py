"""What a scene shows beside actors: obstacles, and targets of hands and feet."""

import numpy as np

from mapctl.curves.obstacles import Obstacle
from mapctl.mesh import colours
from mapctl.mesh.primitives import Array, Surface, unit_sphere

_OBSTACLE_COLOUR = "#b9aa9c"
_HEIGHT, _SHADE = 0.35, 0.82  # metres of an obstacle's walls, and how dark they are beside its top
_TARGET_RADIUS = 0.035  # metres


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
    """Build a small ball at a place that a hand or a foot is to reach."""
    vertices, faces = unit_sphere()
    rgb = np.tile(colours.rgb(colours.TARGET), (len(vertices), 1))
    return _make_flat(_TARGET_RADIUS * vertices + np.array(place), faces, rgb)


def _make_flat(vertices: Array, faces: Array, rgb: Array) -> Surface:
    return Surface(vertices, faces, np.concatenate([rgb, np.ones((len(rgb), 1))], axis=1))
