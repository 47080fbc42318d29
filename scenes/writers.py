"""Pictures into files: MP4 (H.264), GIF and PNG."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from fractions import Fraction
from pathlib import Path

import numpy as np

from mapctl.errors import RequestError
from mapctl.formats import atomic
from scenes.shapes import Array

Write = Callable[[Array], None]
_QUALITY = {"crf": "19", "preset": "veryfast"}
_GIF_COLOURS = 128


@contextmanager
def mp4_writer(path: Path, size: tuple[int, int], fps: Fraction) -> Iterator[Write]:
    """Yield a function that adds a picture (height, width, 3) uint8 to an H.264 film every player can show.

    4:2:0 colour needs even sides, so odd ones get one more row or column like their last.
    """
    av = _package("av")
    # The encoder says what it does on standard error unless told not to.
    av.logging.set_level(av.logging.ERROR)
    width, height = (side + side % 2 for side in size)
    with av.open(str(path), "w", format="mp4", options={"movflags": "faststart"}) as container:
        stream = container.add_stream("libx264", rate=fps, options=_QUALITY)
        stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
        stream.codec_context.thread_count = 1

        def write(picture: Array) -> None:
            edges = ((0, height - picture.shape[0]), (0, width - picture.shape[1]), (0, 0))
            even = np.pad(picture, edges, mode="edge")
            container.mux(stream.encode(av.VideoFrame.from_ndarray(even, format="rgb24")))

        yield write
        container.mux(stream.encode())


@contextmanager
def gif_writer(path: Path, size: tuple[int, int], fps: Fraction) -> Iterator[Write]:
    """Yield a function that adds a picture to a looping GIF. Its palette is the first picture's.

    GIF counts in hundredths of a second; the delays alternate so that the whole keeps the motion's time.
    """
    image = _package("PIL.Image")
    pictures = []

    def write(picture: Array) -> None:
        whole = image.fromarray(picture)
        if pictures:
            pictures.append(whole.quantize(palette=pictures[0], dither=image.Dither.NONE))
        else:
            pictures.append(
                whole.quantize(_GIF_COLOURS, method=image.Quantize.MEDIANCUT, dither=image.Dither.NONE)
            )

    yield write
    ends = [round(100 * (k + 1) / fps) for k in range(len(pictures))]
    delays = [10 * (stop - start) for start, stop in zip([0, *ends], ends, strict=False)]
    pictures[0].save(path, format="GIF", save_all=True, append_images=pictures[1:], duration=delays, loop=0)


def save_png(path: Path, picture: Array) -> None:
    """Write one picture (height, width, 3) uint8, whole or not at all."""
    image = _package("PIL.Image")
    with atomic.atomic_path(path) as scratch:
        image.fromarray(picture).save(scratch, format="PNG", optimize=True)


def _package(name: str):
    from importlib import import_module

    try:
        return import_module(name)
    except ImportError as error:
        raise RequestError(
            f"films need {name.split('.')[0]} ({error}): pip install 'mapctl[render]'"
        ) from error
