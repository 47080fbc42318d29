"""Films of motions: MP4, GIF, WebP, and a PNG contact sheet. Files appear whole or not at all."""

import logging
import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from fractions import Fraction
from functools import partial
from os import PathLike, fspath
from pathlib import Path
from typing import Any

import numpy as np
import torch

from mapctl import retarget
from mapctl.errors import RequestError
from mapctl.formats import atomic
from mapctl.ground import Ground
from mapctl.mesh import colours
from mapctl.mesh.primitives import Array, Surface
from mapctl.motion import Motion
from mapctl.retarget.rigs import Rig
from scenes.cameras import CameraSettings
from scenes.renderers import STICK_FIGURES, Painter, select_painter
from scenes.stage import Shot, Stage

Write = Callable[[Array], None]
_QUALITY = {"crf": "19", "preset": "veryfast"}
_BT709 = 1
"""Code of the HD colour standard in the stream's tags; players that find none guess by the picture's size."""
_LOOP_FPS = 50
"""Browsers slow down loops of pictures that are faster."""
_LOOP_PIXELS = 300_000_000
"""Pixels that all pictures of a loop may have together: they are held in memory until they are written."""


@contextmanager
def mp4_writer(path: Path, size: tuple[int, int], fps: Fraction) -> Iterator[Write]:
    """Yield a function that adds a picture (height, width, 3) uint8 to an H.264 film every player can show.

    4:2:0 colour needs even sides, so odd ones get one more row or column like their last.
    """
    import av

    # The encoder logs what it does on standard error by default.
    av.logging.set_level(av.logging.ERROR)
    width, height = (side + side % 2 for side in size)
    with av.open(str(path), "w", format="mp4", options={"movflags": "faststart"}) as container:
        stream = container.add_stream("libx264", rate=fps, options=_QUALITY)
        stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
        context = stream.codec_context
        context.thread_count = 1
        context.colorspace = context.color_primaries = context.color_trc = _BT709

        def write(picture: Array) -> None:
            edges = ((0, height - picture.shape[0]), (0, width - picture.shape[1]), (0, 0))
            frame = av.VideoFrame.from_ndarray(np.pad(picture, edges, mode="edge"), format="rgb24")
            container.mux(stream.encode(frame.reformat(format="yuv420p", dst_colorspace="ITU709")))

        yield write
        container.mux(stream.encode())


@contextmanager
def _loop_writer(name: str, tick: int, path: Path, size: tuple[int, int], fps: Fraction) -> Iterator[Write]:
    """Yield a function that adds a picture to a looping GIF or WebP.

    Delays alternate between ticks of the format, milliseconds, so that the whole keeps its time. Over 50 pictures a
    second only every second, third, ... is kept. RequestError when it outgrows memory.
    """
    from PIL import Image

    stride, count, pictures = math.ceil(fps / _LOOP_FPS), 0, []
    most = _LOOP_PIXELS // (size[0] * size[1])

    def write(picture: Array) -> None:
        nonlocal count
        if count % stride == 0:
            if len(pictures) == most:
                found = f"a {name} of {size[0]}x{size[1]} can have {most} pictures"
                raise RequestError(f"{found}; shrink it or write an MP4")
            pictures.append(Image.fromarray(picture))
        count += 1

    yield write
    ends = [round(1000 // tick * min((k + 1) * stride, count) / fps) for k in range(len(pictures))]
    delays = [tick * max(stop - start, 1) for start, stop in zip([0, *ends], ends, strict=False)]
    first, *others = pictures
    first.save(path, name, save_all=True, append_images=others, duration=delays, loop=0, quality=75)


def save_png(path: Path, picture: Array) -> None:
    """Write one picture (height, width, 3) uint8, whole or not at all."""
    from PIL import Image

    with atomic.atomic_path(path) as scratch:
        Image.fromarray(picture).save(scratch, format="PNG", optimize=True)


_GAP = 0.008
"""Margin between pictures, as a share of the width."""
_GHOST_STRIDE = 1.0
"""Distance between ghosts, about, metres."""
_STRIP_WIDTH, _STRIP_STILLS, _STRIP_SHAPE = 1280, 9, 1.3
"""Width of a strip, pixels, its stills, and the height of each over its width."""
_MAX_GHOSTS = 16
"""Number of ghosts of all actors together, but at least four each."""


def draw_contact_sheet(stage: Stage, brush: Painter, camera: CameraSettings, size: tuple[int, int]) -> Array:
    """Draw the sheet, (height, width, 3) uint8: a picture of the ghosts of this `size`, and stills as wide below."""
    wide = replace(camera, kind="top" if camera.kind == "top" else "fixed")
    top = brush.paint(stage.views(wide, size)[0], stage.compose_ghosts(_choose_ghost_frames(stage)))
    # One actor has upright close stills; several need the whole picture.
    count, tall, kind = 4, size[1] / size[0], camera.kind
    if len(stage.players) == 1:
        count, tall, kind = 6, 1.15, "top" if camera.kind == "top" else "follow"
    gap = np.full((_measure_gap(size[0]), size[0], 3), 255, np.uint8)
    return np.concatenate([top, gap, _draw_stills(stage, brush, replace(camera, kind=kind), size[0], count, tall)])


def _draw_stills(
    stage: Stage, brush: Painter, camera: CameraSettings, width: int, count: int, tall: float, name: str = ""
) -> Array:
    """Draw a row of stills, `tall` times as high as wide, each under its time or the first under a name."""
    gap = _measure_gap(width)
    each = (width - (count - 1) * gap) // count
    height = max(1, round(each * tall))
    row = np.full((height, width, 3), 255, np.uint8)
    views = stage.views(camera, (each, height))
    for k, moment in enumerate(_space_evenly(stage.num_frames - 1, count)):
        left = round(k * (width - each) / (count - 1))
        label = f"{moment / float(stage.fps):.1f} s" if k or not name else name
        row[:, left : left + each] = _add_label(brush.paint(views[moment], stage.content(moment)), label)
    return row


def _measure_gap(width: int) -> int:
    return max(2, round(_GAP * width))


def _space_evenly(last: int, count: int) -> list[int]:
    return [round(k) for k in np.linspace(0, last, count)]


def _choose_ghost_frames(stage: Stage) -> list[int]:
    """Choose frames about a stride apart for the actor that goes furthest, less the first where a loop ends there."""
    paths = [player.body.anatomy.hips_world[:, [0, 2]] for player in stage.players]
    lengths = [np.linalg.norm(np.diff(path, axis=0), axis=1).sum() for path in paths]
    furthest, last = paths[int(np.argmax(lengths))], stage.num_frames - 1
    # Swaying on the spot makes a long path, too, that leads nowhere.
    reach = np.linalg.norm(furthest - furthest[0], axis=1).max()
    count = min(round(min(max(lengths), 2 * reach) / _GHOST_STRIDE) + 1, max(4, _MAX_GHOSTS // len(paths)))
    if count == 1:
        return [stage.num_frames // 2]
    loop = max(lengths) > 3 * _GHOST_STRIDE and np.linalg.norm(furthest[-1] - furthest[0]) < _GHOST_STRIDE
    return _space_evenly(last, count + 1)[1:] if loop else _space_evenly(last, count)


def _add_label(picture: Array, text: str) -> Array:
    from PIL import Image, ImageDraw, ImageFont

    image = Image.fromarray(picture)
    height = max(9, round(picture.shape[0] * 0.07))
    draw = ImageDraw.Draw(image)
    draw.text((height * 0.6, height * 0.4), text, fill=colours.INK, font=ImageFont.load_default(size=height))
    return np.asarray(image)


WRITERS = {".mp4": mp4_writer, ".gif": partial(_loop_writer, "GIF", 10), ".webp": partial(_loop_writer, "WebP", 1)}
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
    props: Sequence[Surface] = (),
    ground: Ground | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> list[Path]:
    """Film the actors walking together; one pass serves all outputs. Returns the paths written.

    `actors` are Shots, or tuples (motion, curve, colour, start seconds, targets, drawn) of which all but the motion may
    be left out. Where stick figures are drawn a character is one of them, and a line is logged on that. `out` is a
    path or several, each ending in .mp4, .gif, .webp or .png (a contact sheet: ghosts along the trajectory over a row
    of stills). Each frame of the motions is one frame of the film unless `fps` resamples them. `size` is the width and
    height in pixels (MP4 rounds up to even). `props` are what stands around (`scenes.overlays`), `ground` what
    they walk on if it is not flat. `progress` is called with frames done and all frames. RequestError for endings,
    sizes and paths that cannot be.
    """
    paths = check_outputs([out] if isinstance(out, str | PathLike) else out, size)
    shots, brush, camera = [Shot(*actor) for actor in actors], select_painter(), camera or CameraSettings()
    stage = Stage(shots, fps, props, ground)
    if brush.name == STICK_FIGURES and any(shot.drawn is not None for shot in shots):
        _log.warning("stick figures show no mesh: characters are drawn by their bones")
    if moving := [path for path in paths if path.suffix.lower() in WRITERS]:
        _write_films(moving, stage, brush, camera, size, progress)
    for path in paths:
        if path not in moving:
            save_png(path, draw_contact_sheet(stage, brush, camera, size))
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


def draw_strips_to(motions: Sequence[tuple[str, Motion]], path: Path) -> None:
    """Draw motions below each other, a row of stills at the same times of each and under its name, to a .png."""
    brush, camera, width = select_painter(), CameraSettings("follow"), _STRIP_WIDTH
    rows, gap = [], np.full((_measure_gap(width), width, 3), 255, np.uint8)
    for name, motion in motions:
        stage, title = Stage([Shot(motion)]), name.replace(" and ", "\n")
        rows += [gap, _draw_stills(stage, brush, camera, width, _STRIP_STILLS, _STRIP_SHAPE, title)]
    save_png(path, np.concatenate(rows[1:]))


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


def _write_films(
    paths: Sequence[Path],
    stage: Stage,
    brush: Painter,
    camera: CameraSettings,
    size: tuple[int, int],
    progress: Callable[[int, int], None] | None,
) -> None:
    with ExitStack() as open_files:
        writers: list[Write] = []
        for path in paths:
            scratch = open_files.enter_context(atomic.atomic_path(path))
            writers.append(open_files.enter_context(WRITERS[path.suffix.lower()](scratch, size, stage.fps)))
        for frame, view in enumerate(stage.views(camera, size)):
            picture = np.ascontiguousarray(brush.paint(view, stage.content(frame)))
            for write in writers:
                write(picture)
            if progress is not None:
                progress(frame + 1, stage.num_frames)
