"""Where a camera is so that all characters are in view beside the panel. Pure functions."""

import itertools
import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from mapctl.mesh.primitives import Array
from scenes.cameras import View, fit_eye, look_at

FOV = math.radians(40.0)
"""Vertical field of view, radians."""
_MARGIN = 1.16  # of the free part's size to that of the characters in it
_NEAREST_METRES = 4.8  # from a single character
_MOST_STEPS_BACK = 20
_ELEVATION = math.radians(15.0)
_AZIMUTHS = np.radians([180 - 24, 180 - 38, 180 - 52, 180 - 66])  # behind them, from +Z toward +X
_BODY = np.array([0.45, 1.85, 0.55])  # half of the width, the height, half of the depth of a character's space, metres


class Box(NamedTuple):
    """A rectangle of the page, pixels from its top left corner."""

    left: float
    top: float
    width: float
    height: float


@dataclass(frozen=True, eq=False)
class Framing:
    """Place of a camera."""

    position: Array
    """(3,), metres."""
    look_at: Array
    """(3,) point in the middle of the picture, about which it orbits, metres."""


def find_free_part(width: float, height: float, panel: Box | None) -> Box:
    """Return the largest part of a canvas beside, above or below a panel that lies over it."""
    whole = Box(0.0, 0.0, width, height)
    if panel is None:
        return whole
    left, top = max(0.0, panel.left), max(0.0, panel.top)
    right, bottom = min(width, panel.left + panel.width), min(height, panel.top + panel.height)
    if right <= left or bottom <= top:
        return whole
    parts = (
        Box(0.0, 0.0, left, height),
        Box(right, 0.0, width - right, height),
        Box(0.0, 0.0, width, top),
        Box(0.0, bottom, width, height - bottom),
    )
    return max(parts, key=lambda part: min(part.width, part.height * 1.5) * part.height)


def frame_characters(places: Array, size: tuple[float, float], panel: Box | None = None) -> Framing:
    """Frame characters at places (n, 2), x and z in metres, on a canvas of a size in pixels, beside a panel over it.

    Of several directions from behind, that which shows the smallest character largest is taken.
    """
    free = find_free_part(*size, panel)
    points = _list_corners(places)
    found = [_frame_from(azimuth, points, places, size, free) for azimuth in _AZIMUTHS]
    return max(found, key=lambda one: _measure_smallest(one, places, size))


def project(framing: Framing, points: Array, size: tuple[float, float]) -> Array:
    """Return where points (..., 3) are on the canvas: pixels right, pixels down, metres away."""
    pose = look_at(framing.position, framing.look_at)
    return View(pose, FOV, round(size[0]), round(size[1])).project(points)


def bound_characters(framing: Framing, places: Array, size: tuple[float, float]) -> list[Box]:
    """Return each character's rectangle on the canvas."""
    boxes = []
    for place in places:
        flat = project(framing, _list_corners(place[None]), size)[:, :2]
        low, high = flat.min(axis=0), flat.max(axis=0)
        boxes.append(Box(*low.tolist(), *(high - low).tolist()))
    return boxes


def _list_corners(places: Array) -> Array:
    """List the corners (8 n, 3) of the characters' spaces."""
    across = np.array([[x, z] for x in (-_BODY[0], _BODY[0]) for z in (-_BODY[2], _BODY[2])])
    flat = (places[:, None] + across).reshape(-1, 2)
    return np.concatenate([np.insert(flat, 1, height, axis=1) for height in (0.0, _BODY[1])])


def _frame_from(azimuth: float, points: Array, places: Array, size: tuple[float, float], free: Box) -> Framing:
    level = np.array([math.sin(azimuth), 0.0, math.cos(azimuth)])
    back = math.cos(_ELEVATION) * level + math.sin(_ELEVATION) * np.array([0.0, 1.0, 0.0])
    axes = look_at(back, np.zeros(3))[:3, :3]
    slope = math.tan(FOV / 2)  # of half the canvas' height
    part = 2 * math.atan(slope * free.height / size[1] / _MARGIN)
    eye = fit_eye(points, axes, fov=part, aspect=free.width / free.height)
    middle = np.array([*places.mean(axis=0), _BODY[1] / 2])[[0, 2, 1]]
    away = float((eye - middle) @ back)
    if away < _NEAREST_METRES:
        eye, away = eye + (_NEAREST_METRES - away) * back, _NEAREST_METRES
    framing = _move_aside(eye, away, axes, size, free)
    for _ in range(_MOST_STEPS_BACK):
        if _is_within(free, project(framing, points, size)):
            break
        eye, away = eye + 0.05 * away * back, 1.05 * away
        framing = _move_aside(eye, away, axes, size, free)
    return framing


def _is_within(part: Box, flat: Array) -> bool:
    low, high = flat[:, :2].min(axis=0), flat[:, :2].max(axis=0)
    return bool((low >= part[:2]).all() and (high <= np.add(part[:2], part[2:])).all())


def _move_aside(eye: Array, away: float, axes: Array, size: tuple[float, float], free: Box) -> Framing:
    """Move a camera so that what is `away` metres before it is in the middle of the free part, not of the canvas."""
    pixel = 2 * math.tan(FOV / 2) * away / size[1]
    aside = (size[0] / 2 - free.left - free.width / 2) * pixel
    down = (free.top + free.height / 2 - size[1] / 2) * pixel
    eye = eye + aside * axes[:, 0] + down * axes[:, 1]
    return Framing(eye, eye - away * axes[:, 2])


def _measure_smallest(framing: Framing, places: Array, size: tuple[float, float]) -> float:
    """Return the height in pixels of the smallest character; less where they hide each other."""
    boxes = sorted(bound_characters(framing, places, size), key=lambda box: box.left)
    pairs = itertools.pairwise(boxes)
    hidden = [max(0.0, a.left + a.width - b.left) / min(a.width, b.width) for a, b in pairs]
    return min(box.height for box in boxes) * (1.0 - 0.8 * max([0.35, *hidden]))
