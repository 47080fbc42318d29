"""The contact sheet: the whole motion with ghosts along its trajectory, and a row of stills below it."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from mapctl.mesh import colours
from mapctl.mesh.primitives import Array
from scenes.cameras import CameraSettings
from scenes.content import Painter
from scenes.stage import Stage

_GAP = 0.008
"""Margin between pictures, as a share of the width."""
_GHOST_STRIDE = 1.0
"""Distance between ghosts, about, metres."""
_STRIP_STILLS, _STRIP_SHAPE = 9, 1.3
"""Stills of a strip, and the height of each over its width."""
_MAX_GHOSTS = 16
"""Number of ghosts of all actors together, but at least four each."""


@dataclass(frozen=True)
class StillRow:
    """Layout of the stills."""

    count: int
    """Number of stills beside each other."""
    height_over_width: float
    """Height of one over its width."""
    kind: str
    """Kind of the stills' camera (see CameraSettings)."""


def draw_contact_sheet(stage: Stage, brush: Painter, camera: CameraSettings, size: tuple[int, int]) -> Array:
    """Draw the sheet, (height, width, 3) uint8 of the given width; the ghosts' picture has `size`, the stills come
    below."""
    wide = replace(camera, kind="top" if camera.kind == "top" else "fixed")
    top = brush.paint(stage.views(wide, size)[0], stage.compose_ghosts(_choose_ghost_frames(stage)))
    row = _choose_row(stage, camera, size)
    gap = max(2, round(_GAP * size[0]))
    width = (size[0] - (row.count - 1) * gap) // row.count
    height = max(1, round(width * row.height_over_width))
    sheet = np.full((size[1] + gap + height, size[0], 3), 255, np.uint8)
    sheet[: size[1]] = top
    views = stage.views(replace(camera, kind=row.kind), (width, height))
    for k, moment in enumerate(_space_evenly(stage.num_frames - 1, row.count)):
        left = round(k * (size[0] - width) / (row.count - 1))
        still = _add_label(brush.paint(views[moment], stage.content(moment)), f"{moment / float(stage.fps):.1f} s")
        sheet[size[1] + gap :, left : left + width] = still
    return sheet


def draw_strips(
    strips: Sequence[tuple[str, Stage]], brush: Painter, camera: CameraSettings, size: tuple[int, int]
) -> Array:
    """Draw a row of stills of each stage, at the same shares of its time, below each other and under its name: (height,
    width, 3) uint8 of the given width, all rows together as high as they come."""
    gap = max(2, round(_GAP * size[0]))
    width = (size[0] - (_STRIP_STILLS - 1) * gap) // _STRIP_STILLS
    height = round(width * _STRIP_SHAPE)
    sheet = np.full((len(strips) * (height + gap) - gap, size[0], 3), 255, np.uint8)
    for row, (name, stage) in enumerate(strips):
        views, top = stage.views(camera, (width, height)), row * (height + gap)
        for k, moment in enumerate(_space_evenly(stage.num_frames - 1, _STRIP_STILLS)):
            left, label = k * (width + gap), f"{moment / float(stage.fps):.1f} s"
            picture = _add_label(
                brush.paint(views[moment], stage.content(moment)), label if k else name.replace(" and ", "\n")
            )
            sheet[top : top + height, left : left + width] = picture
    return sheet


def _choose_row(stage: Stage, camera: CameraSettings, size: tuple[int, int]) -> StillRow:
    """Choose upright close stills for one actor; several need the whole picture."""
    if len(stage.players) == 1:
        return StillRow(6, 1.15, "top" if camera.kind == "top" else "follow")
    return StillRow(4, size[1] / size[0], camera.kind)


def _space_evenly(last: int, count: int) -> list[int]:
    return [round(k) for k in np.linspace(0, last, count)]


def _choose_ghost_frames(stage: Stage) -> list[int]:
    """Choose frames about a stride apart for the actor that goes furthest, less the first where a loop ends there."""
    paths = [player.body.anatomy.hips_world[:, [0, 2]] for player in stage.players]
    lengths = [np.linalg.norm(np.diff(path, axis=0), axis=1).sum() for path in paths]
    most = max(4, _MAX_GHOSTS // len(paths))
    furthest = paths[int(np.argmax(lengths))]
    # Swaying on the spot makes a long path, too, that leads nowhere.
    reach = np.linalg.norm(furthest - furthest[0], axis=1).max()
    count = min(round(min(max(lengths), 2 * reach) / _GHOST_STRIDE) + 1, most)
    if count == 1:
        return [stage.num_frames // 2]
    loop = max(lengths) > 3 * _GHOST_STRIDE and np.linalg.norm(furthest[-1] - furthest[0]) < _GHOST_STRIDE
    return _space_evenly(stage.num_frames - 1, count + 1)[1:] if loop else _space_evenly(stage.num_frames - 1, count)


def _add_label(picture: Array, text: str) -> Array:
    from PIL import Image, ImageDraw, ImageFont

    image = Image.fromarray(picture)
    height = max(9, round(picture.shape[0] * 0.07))
    draw = ImageDraw.Draw(image)
    draw.text((height * 0.6, height * 0.4), text, fill=colours.VISOR, font=ImageFont.load_default(size=height))
    return np.asarray(image)
