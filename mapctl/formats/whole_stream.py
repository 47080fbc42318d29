"""A motion taken piece by piece and written at the end, in formats that are written as a whole."""

from collections.abc import Iterator
from contextlib import contextmanager
from os import PathLike

from mapctl import formats
from mapctl.errors import MapctlError
from mapctl.motion import Motion


class WholeStream:
    """Takes pieces in turn and keeps them, as `BvhStream` takes them and writes them."""

    def __init__(self):
        self._pieces: list[Motion] = []

    @property
    def written(self) -> int:
        """Frames taken so far."""
        return sum(piece.num_frames for piece in self._pieces)

    def append(self, piece: Motion) -> None:
        """Take the next piece."""
        self._pieces.append(piece)

    def join(self) -> Motion:
        """Join the pieces; at least one must have been taken."""
        whole, *others = self._pieces
        for piece in others:
            whole = whole.join(piece)
        return whole


@contextmanager
def open_whole_stream(path: str | PathLike[str], frames: int) -> Iterator[WholeStream]:
    """Yield a stream that takes the pieces of a motion; they are written when the block ends well.

    MapctlError if the pieces are not `frames` frames in all, RequestError if the path cannot be written.
    """
    stream = WholeStream()
    yield stream
    if stream.written != frames:
        raise MapctlError(f"{path}: {stream.written} frames were written, {frames} were announced")
    formats.save(stream.join(), path)
