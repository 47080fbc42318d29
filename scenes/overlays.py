"""Marks on the ground: metre grid, curve, walked trail, planted-foot marks, soft shadows.

All are flat surfaces a few millimetres apart; whoever draws them keeps the order of this file.
"""

from dataclasses import replace

import numpy as np
import scipy
import torch

from mapctl.curves.obstacles import Obstacle
from mapctl.ground import Ground
from mapctl.mesh import colours
from mapctl.mesh.primitives import Array, Surface, merge_surfaces, unit

TILE_HEIGHT, LINE_HEIGHT, TARGET_HEIGHT, TRAIL_HEIGHT, MARK_HEIGHT, SHADOW_HEIGHT = np.arange(6) * 0.002
LIGHT = unit(np.array([-0.34, -1.0, -0.28]))
"""Direction in which the light of the shadows travels."""
_LINE, _MAJOR_LINE = 0.014, 0.03
_MAX_TILES = 60
_SQUARE = np.array([[0, 0], [0, 1], [1, 1], [1, 0]])
_FADE_START, _FADE_END = 2.0, 6.5
_SHADOW_CELLS = 52
_SHADOW_STRENGTH = 0.5


def build_grid(positions: Array) -> Surface:
    """Build squares of 1 m and lines, every fifth stronger, around positions (n, 2) x, z; they fade with distance.

    Where the positions are more than 60 m apart the squares grow to 5 m, 25 m and so on.
    """
    low, high = positions.min(axis=0) - _FADE_END, positions.max(axis=0) + _FADE_END
    step = 1.0
    while (high - low).max() / step > _MAX_TILES:
        step *= 5
    first, last = np.floor(low / step).astype(int), np.ceil(high / step).astype(int)
    x, z = (np.arange(a, b + 1) for a, b in zip(first, last, strict=True))
    a, b = np.meshgrid(x[:-1], z[:-1], indexing="ij")
    dark = (a + b) % 2 == 0  # every second square of a chessboard
    tiles = (np.stack([a[dark], b[dark]], axis=-1)[:, None] + _SQUARE) * step
    lines = [_build_lines(x, z, step), _build_lines(z, x, step)[:, ::-1, ::-1]]
    strong = np.concatenate([np.repeat(x % 5 == 0, len(z) - 1), np.repeat(z % 5 == 0, len(x) - 1)])
    quads, is_tile = np.concatenate([tiles, *lines]), np.arange(len(tiles) + len(strong)) < len(tiles)
    strength = np.concatenate([np.ones(len(tiles)), np.where(strong, 1.0, 0.62)])
    # Colours fade to the background's, opaque, for eight bits of opacity show as rings.
    distance = scipy.spatial.KDTree(positions).query(quads.reshape(-1, 2))[0].reshape(-1, 4)
    share = np.clip((_FADE_END - distance) / (_FADE_END - _FADE_START), 0, 1)
    shown = strength[:, None] * share * share * (3 - 2 * share)
    kept = shown.max(axis=1) > 0
    height = np.repeat(np.where(is_tile, TILE_HEIGHT, LINE_HEIGHT)[kept], 4)
    rgb = np.where(is_tile[:, None], colours.rgb(colours.TILE), colours.rgb(colours.GRID))[kept].repeat(4, axis=0)
    rgb = colours.blend_colours(colours.rgb(colours.BACKGROUND), rgb, shown[kept].reshape(-1, 1))
    vertices = np.insert(quads[kept].reshape(-1, 2), 1, height, axis=1)
    faces = _triangulate_quads(np.arange(len(vertices)).reshape(-1, 4))
    return Surface(vertices, faces, np.column_stack([rgb, np.ones(len(rgb))]))


def _build_lines(x: Array, z: Array, step: float) -> Array:
    """Build lines along z in pieces of one square, so that they can fade, (quads, 4, 2)."""
    a, b = (values.reshape(-1, 1, 1) for values in np.meshgrid(x, z[:-1], indexing="ij"))
    width = np.where(a % 5 == 0, _MAJOR_LINE, _LINE) * step**0.5
    across = a * step + width * (_SQUARE[:, :1] - 0.5)
    return np.concatenate([across, (b + _SQUARE[:, 1:]) * step], axis=-1)


def build_ribbon(points: Array, *, width: float, rgb: Array, height: float) -> Surface:
    """Build a flat band along points (n, 2) x, z on the ground, or (n, 3) in space, of constant width in metres."""
    space = np.insert(points, 1, 0.0, axis=1) if points.shape[1] == 2 else points
    space = space + np.array([0.0, height, 0.0])
    along = np.gradient(space[:, [0, 2]], axis=0) if len(space) > 1 else np.ones((1, 2))
    side = unit(np.stack([along[:, 1], -along[:, 0]], axis=-1)) * width / 2
    side = np.insert(side, 1, 0.0, axis=1)
    vertices = np.stack([space + side, space - side], axis=1).reshape(-1, 3)
    index = np.arange(2 * len(space)).reshape(-1, 2)
    quads = np.concatenate([index[:-1], index[1:, ::-1]], axis=1)
    return Surface(vertices, _triangulate_quads(quads), np.tile([*rgb, 1.0], (len(vertices), 1)))


def cut_ribbon(whole: Surface, points: int) -> Surface:
    """Return the first `points` points of a ribbon."""
    return Surface(whole.vertices[: 2 * points], whole.faces[: 2 * max(points - 1, 0)], whole.rgba[: 2 * points])


def build_discs(centres: Array, rgb: Array, *, radius: float = 0.085, corners: int = 24) -> Surface:
    """Build marks on the ground at centres (n, 2) x, z in colours (n, 3): a disc that is pale in its middle."""
    turn = np.arange(corners) * 2 * np.pi / corners
    rim = radius * np.stack([np.sin(turn), np.cos(turn)], axis=-1)
    flat = (centres[:, None] + np.concatenate([np.zeros((1, 2)), rim])).reshape(-1, 2)
    alpha = np.tile(np.repeat([0.2, 0.9], [1, corners]), len(centres))
    index = 1 + np.arange(corners)
    fan = np.stack([np.zeros(corners, int), index, np.roll(index, -1)], axis=-1)
    faces = fan + (corners + 1) * np.arange(len(centres))[:, None, None]
    rgba = np.column_stack([np.repeat(rgb, corners + 1, axis=0), alpha])
    return Surface(np.insert(flat, 1, MARK_HEIGHT, axis=1), faces.reshape(-1, 3), rgba)


def build_arrow(start: Array, heading: float, rgb: Array, *, length: float) -> Surface:
    """Build a flat arrow on the ground from a start (2,) x, z along a heading, radians from +Z toward +X."""
    shaft, wing = 0.08, 0.26  # half widths, shares of the length
    along, left = np.array([np.sin(heading), np.cos(heading)]), np.array([np.cos(heading), -np.sin(heading)])
    outline = [(0, shaft), (0.55, shaft), (0.55, -shaft), (0, -shaft), (0.55, wing), (1, 0), (0.55, -wing)]
    flat = np.stack([start + length * (ahead * along + aside * left) for ahead, aside in outline])
    vertices = np.insert(flat, 1, MARK_HEIGHT + 0.001, axis=1)
    faces = np.array([[0, 2, 1], [0, 3, 2], [4, 6, 5]])
    return Surface(vertices, faces, np.tile([*rgb, 0.9], (len(flat), 1)))


def build_shadow(segments: Array, radii: Array, *, layer: int = 0) -> Surface:
    """Build the soft shadow of capsules (n, 2, 3) on the ground, darker and sharper the closer they are to it.

    Each capsule falls along LIGHT; the higher it is the more its edge is blurred, as under a large lamp. `layer` keeps
    the shadows of several actors apart.
    """
    flat = segments[..., [0, 2]] - segments[..., 1:2] * (LIGHT[[0, 2]] / LIGHT[1])
    blur = 0.02 + 0.22 * np.clip(segments[..., 1], 0, None)
    margin = (radii[:, None] + blur)[..., None]
    low, high = (flat - margin).min(axis=(0, 1)), (flat + margin).max(axis=(0, 1))
    x, z = (np.linspace(a, b, _SHADOW_CELLS, dtype=np.float32) for a, b in zip(low, high, strict=True))
    positions = np.stack(np.meshgrid(x, z, indexing="ij"), axis=-1).reshape(-1, 2)
    alpha = _SHADOW_STRENGTH * (
        1 - _compute_transmittance(positions, *(v.astype(np.float32) for v in (flat, blur, radii)))
    )
    rgba = np.concatenate([np.tile(colours.rgb(colours.SHADOW), (len(positions), 1)), alpha[:, None]], axis=1)
    index = np.arange(len(positions)).reshape(_SHADOW_CELLS, _SHADOW_CELLS)
    quads = np.stack([index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]], axis=-1).reshape(-1, 4)
    shown = alpha[quads].max(axis=1) > 0.004
    return Surface(
        np.insert(positions, 1, SHADOW_HEIGHT + 0.0005 * layer, axis=1), _triangulate_quads(quads[shown]), rgba
    )


def _compute_transmittance(positions: Array, flat: Array, blur: Array, radii: Array) -> Array:
    """Compute the share of light that reaches each position (m, 2) past all capsules."""
    left = np.ones(len(positions), dtype=np.float32)
    for (start, stop), soft, radius in zip(flat, blur, radii, strict=True):
        along = stop - start
        away = positions - start
        share = np.clip(away @ along / max(float(along @ along), 1e-9), 0, 1)
        away -= share[:, None] * along
        distance = np.sqrt(np.einsum("ij,ij->i", away, away))
        edge = soft[0] + (soft[1] - soft[0]) * share
        # Between radius - edge and radius + edge light grows smoothly; a wide edge also means a fainter core.
        cover = np.clip((radius + edge - distance) / (2 * edge), 0, 1)
        left *= 1 - cover * cover * (3 - 2 * cover) * np.minimum(1, 1.6 * radius / (radius + edge))
    return left


def _triangulate_quads(quads: Array) -> Array:
    """Return two triangles for each quad (n, 4), next to each other so that the drawing order stays."""
    return quads[:, [0, 1, 2, 0, 2, 3]].reshape(-1, 3)


_OBSTACLE_COLOUR = "#b9aa9c"
_GROUND_COLOUR, _WALL, _FIELD_CELLS = "#cfc8be", 0.72, 160
_HEIGHT, _SHADE = 0.35, 0.82  # metres of an obstacle's walls, and how dark they are beside its top
_TARGET_RADIUS, _LOOK_RADIUS, _HIPS_RADIUS = 0.035, 0.05, 0.16  # metres


def build_obstacle(obstacle: Obstacle) -> Surface:
    """Build a low solid on the ground with the obstacle's outline, its walls darker than its top."""
    outline = obstacle.outline().numpy()
    count = len(outline)
    low, high = (np.insert(outline, 1, height, axis=1) for height in (0.0, _HEIGHT))
    index = np.arange(count)
    following = np.roll(index, -1)
    walls = _triangulate_quads(np.stack([index, following, following + count, index + count], axis=1))
    fan = np.stack([np.zeros(count - 2, int), index[1:-1], index[2:]], axis=1)
    sides = _make_plain(np.concatenate([low, high]), np.concatenate([walls, walls[:, ::-1]]), _OBSTACLE_COLOUR)
    sides.rgba[:, :3] *= _SHADE
    return merge_surfaces([sides, _make_plain(high, np.concatenate([fan, fan[:, ::-1]]), _OBSTACLE_COLOUR)])


def raise_onto(points: Array, ground: Ground | None, times: int = 1) -> Array:
    """Raise points (..., 3), metres, by the ground's height below them, or lower them by it where `times` is -1."""
    if ground is None:
        return points
    height = ground.height(torch.from_numpy(points[..., [0, 2]])).numpy()
    return points + times * height[..., None] * np.array([0.0, 1.0, 0.0])


def drape(surface: Surface, ground: Ground | None) -> Surface:
    """Lay a flat surface onto the ground."""
    return replace(surface, vertices=raise_onto(surface.vertices, ground))


def build_ground(ground: Ground) -> Surface:
    """Build the slabs of a ground, their walls darker than their tops, and its height field."""
    found = []
    if ground.image is not None:
        x, z = (
            centre + size * np.linspace(-0.5, 0.5, _FIELD_CELLS)
            for centre, size in zip(ground.image.centre, ground.image.size, strict=True)
        )
        flat = np.stack(np.meshgrid(x, z, indexing="ij"), axis=-1).reshape(-1, 2)
        vertices = raise_onto(np.insert(flat, 1, 0.0, axis=1), replace(ground, boxes=(), ramps=(), stairs=()))
        index = np.arange(_FIELD_CELLS**2).reshape(_FIELD_CELLS, _FIELD_CELLS)
        quads = np.stack([index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]], axis=-1).reshape(-1, 4)
        field = _make_plain(vertices, _triangulate_quads(quads), _GROUND_COLOUR)
        slopes = np.stack(np.gradient(vertices[:, 1].reshape(_FIELD_CELLS, -1), x, z), axis=-1).reshape(-1, 2)
        field.rgba[:, :3] *= np.clip(1 + slopes @ LIGHT[[0, 2]], _WALL, 1)[:, None]
        found.append(field)
    for slab in ground.slabs:
        top = slab.corners()
        low = top * np.array([1.0, 0.0, 1.0])
        index, following = np.arange(4), np.roll(np.arange(4), -1)
        walls = _triangulate_quads(np.stack([index, following, following + 4, index + 4], axis=1))
        sides = _make_plain(np.concatenate([low, top]), walls, _GROUND_COLOUR)
        sides.rgba[:, :3] *= _WALL
        found += [sides, _make_plain(top, np.array([[0, 1, 2], [0, 2, 3]]), _GROUND_COLOUR)]
    return merge_surfaces(found)


def build_target(position: tuple[float, float, float]) -> Surface:
    """Build a small ball at a position (x, y, z), metres, that a hand or a foot is to reach."""
    import trimesh  # of the extras that draw

    ball = trimesh.creation.icosphere(subdivisions=2, radius=_TARGET_RADIUS)
    return _make_plain(np.array(ball.vertices) + position, np.array(ball.faces), colours.TARGET)


def build_look_mark(position: tuple[float, float, float]) -> Surface:
    """Build a small octahedron at a position to be looked at."""
    axes = np.concatenate([np.eye(3), -np.eye(3)])
    faces = np.array([[x, y, z] for x in (0, 3) for y in (1, 4) for z in (2, 5)])
    return _make_plain(_LOOK_RADIUS * axes + np.array(position), faces, colours.TARGET)


def build_hips_mark(position: Array, heading: float | None) -> Surface:
    """Build a disc on the ground where hips are to be, (x, z) metres, with an arrow to where they are to face, radians
    from +Z toward +X; without one where they may face anywhere."""
    rgb = colours.rgb(colours.TARGET)
    disc = build_discs(position[None], rgb[None], radius=_HIPS_RADIUS)
    if heading is None:
        return disc
    return merge_surfaces([disc, build_arrow(position, heading, rgb, length=3 * _HIPS_RADIUS)])


def _make_plain(vertices: Array, faces: Array, colour: str) -> Surface:
    return Surface(vertices, faces, np.tile([*colours.rgb(colour), 1.0], (len(vertices), 1)))
