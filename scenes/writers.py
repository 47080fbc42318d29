"""Pictures into files: MP4 (H.264), GIF, WebP and PNG."""

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from fractions import Fraction
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from mapctl.errors import RequestError
from mapctl.formats import atomic
from mapctl.mesh import colours
from mapctl.mesh.primitives import Array

Write = Callable[[Array], None]
_QUALITY = {"crf": "19", "preset": "veryfast"}
_BT709 = 1
"""Code of the HD colour standard in the stream's tags; players that find none guess by the picture's size."""
_GIF_COLOURS = 255
_LOOP_FPS = 50
"""Browsers slow down loops of pictures that are faster."""


@dataclass(frozen=True)
class _Loop:
    """A format of pictures that repeat for ever. All are held in memory until they are written."""

    name: str
    """Name of the format."""
    tick: int
    """Milliseconds in which it counts."""
    most_pixels: int
    """Pixels that all pictures may have together."""
    quality: int = 0
    """Quality, 0 to 100, where the format loses some."""


_GIF, _WEBP = _Loop("GIF", 10, 600_000_000), _Loop("WebP", 1, 200_000_000, quality=75)


@contextmanager
def mp4_writer(path: Path, size: tuple[int, int], fps: Fraction) -> Iterator[Write]:
    """Yield a function that adds a picture (height, width, 3) uint8 to an H.264 film every player can show.

    4:2:0 colour needs even sides, so odd ones get one more row or column like their last.
    """
    av = _import_package("av")
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
def gif_writer(path: Path, size: tuple[int, int], fps: Fraction) -> Iterator[Write]:
    """Yield a function that adds a picture to a looping GIF. All share one palette.

    GIF counts in hundredths of a second; the delays alternate so that the whole keeps its time. Over 50
    pictures a second only every second, third, ... is kept. RequestError when it outgrows 600 megapixels.
    """
    image = _import_package("PIL.Image")
    with _loop_writer(_GIF, lambda picture, first: _quantize(image, picture, first), path, size, fps) as write:
        yield write


@contextmanager
def webp_writer(path: Path, size: tuple[int, int], fps: Fraction) -> Iterator[Write]:
    """Yield a function that adds a picture to a looping WebP, in all colours.

    WebP counts in milliseconds; the delays alternate so that the whole keeps its time. Over 50 pictures a second only
    every second, third, ... is kept. RequestError when it outgrows 200 megapixels.
    """
    image = _import_package("PIL.Image")
    with _loop_writer(_WEBP, lambda picture, _: image.fromarray(picture), path, size, fps) as write:
        yield write


@contextmanager
def _loop_writer(
    form: _Loop, prepare: Callable[[Array, Any], Any], path: Path, size: tuple[int, int], fps: Fraction
) -> Iterator[Write]:
    """Yield a function that adds a picture, as `prepare` makes it of one and of the first that it made."""
    stride, count, pictures = math.ceil(fps / _LOOP_FPS), 0, []

    def write(picture: Array) -> None:
        nonlocal count
        count += 1
        if (count - 1) % stride == 0:
            _check_loop_size(form, len(pictures) + 1, size)
            pictures.append(prepare(picture, pictures[0] if pictures else None))

    yield write
    ends = [round(1000 // form.tick * min((k + 1) * stride, count) / fps) for k in range(len(pictures))]
    delays = [form.tick * max(stop - start, 1) for start, stop in zip([0, *ends], ends, strict=False)]
    first, *others = pictures
    first.save(path, form.name, save_all=True, append_images=others, duration=delays, loop=0, quality=form.quality)


def _check_loop_size(form: _Loop, pictures: int, size: tuple[int, int]) -> None:
    most = form.most_pixels // (size[0] * size[1])
    if pictures > most:
        raise RequestError(f"a {form.name} of {size[0]}x{size[1]} can have {most} pictures; shrink it or write an MP4")


def _quantize(image, picture: Array, first):
    """Quantise with the palette of the first picture, or for the first with one of its own."""
    whole, plain = image.fromarray(picture), image.Dither.NONE
    if first is None:
        sample = image.fromarray(np.concatenate([picture, _make_swatches(picture.shape[1], picture.shape[0] // 12)]))
        first = sample.quantize(_GIF_COLOURS, method=image.Quantize.MAXCOVERAGE, dither=plain)
    return whole.quantize(palette=first, dither=plain)


def _make_swatches(width: int, height: int) -> Array:
    """Make (4 * ceil(height / 4), width, 3): colours in light and shade that the first picture may lack."""
    shown = (colours.LEFT, colours.RIGHT, colours.TARGET, colours.TRAIL)
    light = np.linspace(0.55, 1.0, width)[:, None]
    rows = np.stack([colours.rgb(colour) * light * 255 for colour in shown])
    return np.repeat(rows.astype(np.uint8), math.ceil(height / len(shown)), axis=0)


def save_png(path: Path, picture: Array) -> None:
    """Write one picture (height, width, 3) uint8, whole or not at all."""
    image = _import_package("PIL.Image")
    with atomic.atomic_path(path) as scratch:
        image.fromarray(picture).save(scratch, format="PNG", optimize=True)


def _import_package(name: str):
    try:
        return import_module(name)
    except ImportError as error:
        raise RequestError(f"films need {name.split('.')[0]} ({error}): pip install 'mapctl[render]'") from error
