"""Films of motions: MP4, GIF, WebP, and a PNG contact sheet. Files appear whole or not at all."""

import logging
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import replace
from fractions import Fraction
from os import PathLike, fspath
from pathlib import Path
from typing import Any

import numpy as np
import torch

from mapctl import retarget
from mapctl.errors import RequestError
from mapctl.formats import atomic
from mapctl.mesh.primitives import Array, Surface
from mapctl.motion import Motion
from mapctl.retarget.rigs import Rig
from scenes.cameras import CameraSettings
from scenes.contact_sheet import draw_contact_sheet, draw_strips
from scenes.content import Painter
from scenes.renderers import STICK_FIGURES
from scenes.renderers.select import RendererName, select_painter
from scenes.stage import Shot, Stage
from scenes.writers import gif_writer, mp4_writer, save_png, webp_writer

WRITERS = {".mp4": mp4_writer, ".gif": gif_writer, ".webp": webp_writer}
ENDINGS = (*WRITERS, ".png")
"""Endings that `film` can write."""
_MIN_PIXELS, _MAX_PIXELS = 16, 8192
_SIDE_OFFSET = 1.4  # metres between two characters side by side
_log = logging.getLogger("mapctl.scenes")

PathOrText = str | PathLike[str]


def film(
    actors: Sequence[tuple[Any, ...]],
    out: PathOrText | Sequence[PathOrText],
    *,
    camera: CameraSettings | None = None,
    size: tuple[int, int] = (1280, 720),
    fps: Fraction | float | None = None,
    renderer: RendererName | None = None,
    props: Sequence[Surface] = (),
    progress: Callable[[int, int], None] | None = None,
) -> list[Path]:
    """Film the actors walking together; one pass serves all outputs. Returns the paths written.

    `actors` are Shots, or tuples (motion, curve, colour, start seconds, wishes, drawn) of which all but the motion may
    be left out. Where stick figures are drawn a character is one of them, and a line is logged that says so. `out` is a
    path or several, each ending in .mp4, .gif, .webp or .png (a contact sheet: ghosts along the trajectory over a row
    of stills). Each frame of the motions is one frame of the film unless `fps` resamples them. `size` is the width and
    height in pixels (MP4 rounds up to even). `props` are what stands around (`scenes.props`). `progress` is called with
    frames done and all frames. `renderer` is that of `scenes.renderers.select.select_painter`. RequestError for
    endings, sizes and paths that cannot be.
    """
    paths = check_outputs([out] if isinstance(out, str | PathLike) else out, size)
    shots, brush, camera = [Shot(*actor) for actor in actors], select_painter(renderer), camera or CameraSettings()
    stage = Stage(shots, fps, props)
    if brush.name == STICK_FIGURES and any(shot.drawn is not None for shot in shots):
        _log.warning("stick figures show no mesh: characters are drawn by their bones")
    moving, sheets = (
        [p for p in paths if p.suffix.lower() in WRITERS],
        [p for p in paths if p.suffix.lower() == ".png"],
    )
    if moving:
        _write_films(moving, stage, brush, camera, size, progress)
    if sheets:
        picture = draw_contact_sheet(stage, brush, camera, size)
        for path in sheets:
            save_png(path, picture)
    return paths


def film_side_by_side(
    capture: Motion,
    clean: Motion,
    path: PathOrText,
    *,
    rig: Rig | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> None:
    """Film a capture, grey, and the result beside it."""
    before, after = (retarget.to_canonical(motion, rig)[0] for motion in (capture, clean))
    aside = torch.tensor([_SIDE_OFFSET, 0.0, 0.0], dtype=torch.float64)
    beside = replace(before, root_position=before.root_position + aside)
    film([(after, None), (beside, None, "#999999")], path, progress=progress)


def draw_strips_to(
    motions: Sequence[tuple[str, Motion]], out: PathOrText, *, size: tuple[int, int] = (1280, 720)
) -> None:
    """Draw motions below each other, a row of stills at the same times of each and under its name, to a .png; `size` is
    its width, pixels, and a height that is passed over: rows are as high as they come. RequestError for other
    endings."""
    (path,) = check_outputs([out], size)
    if path.suffix.lower() != ".png":
        raise RequestError(f"motions below each other are a .png, not {path}")
    strips = [(name, Stage([Shot(motion)])) for name, motion in motions]
    save_png(path, draw_strips(strips, select_painter(None), CameraSettings("follow"), size))


def check_outputs(out: Sequence[PathOrText], size: tuple[int, int]) -> list[Path]:
    """Check outputs before any long work; return the paths. RequestError otherwise."""
    width, height = size
    if not (_MIN_PIXELS <= width <= _MAX_PIXELS and _MIN_PIXELS <= height <= _MAX_PIXELS):
        raise RequestError(f"the size must be {_MIN_PIXELS} to {_MAX_PIXELS} pixels a side, got {width}x{height}")
    for path in out:
        ending = Path(path).suffix.lower()
        if ending not in ENDINGS:
            raise RequestError(
                f"cannot film to {fspath(path)}: unknown ending {ending!r}; allowed: {', '.join(ENDINGS)}"
            )
        atomic.check_writable(path)
    return [Path(path) for path in out]


def render_frames(stage: Stage, brush: Painter, camera: CameraSettings, size: tuple[int, int]) -> Iterator[Array]:
    """Render every picture of a film in turn, (height, width, 3) uint8."""
    for frame, view in enumerate(stage.views(camera, size)):
        yield brush.paint(view, stage.content(frame))


def _write_films(
    paths: Sequence[Path],
    stage: Stage,
    brush: Painter,
    camera: CameraSettings,
    size: tuple[int, int],
    progress: Callable[[int, int], None] | None,
) -> None:
    with ExitStack() as open_files:
        writers: list[Any] = []
        for path in paths:
            scratch = open_files.enter_context(atomic.atomic_path(path))
            writers.append(open_files.enter_context(WRITERS[path.suffix.lower()](scratch, size, stage.fps)))
        for done, picture in enumerate(render_frames(stage, brush, camera, size), start=1):
            for write in writers:
                write(np.ascontiguousarray(picture))
            if progress is not None:
                progress(done, stage.num_frames)
