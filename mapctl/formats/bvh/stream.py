"""A BVH file written piece by piece, so that memory does not grow with the motion's length."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from os import PathLike
from typing import TextIO

import numpy as np

from mapctl.errors import MapctlError
from mapctl.formats import bvh
from mapctl.formats.atomic import atomic_path
from mapctl.formats.bvh import euler
from mapctl.formats.bvh import layout as bvh_layout
from mapctl.formats.bvh import text as bvh_text
from mapctl.formats.bvh.hierarchy import Hierarchy
from mapctl.motion import Motion


@contextmanager
def open_bvh_stream(path: str | PathLike[str], frames: int) -> Iterator["BvhStream"]:
    """Yield a stream that takes the pieces of a motion; the file appears whole when the block ends well.

    MapctlError if the pieces are not `frames` frames in all, RequestError if the path cannot be written.
    """
    with atomic_path(path) as scratch:
        with scratch.open("w", encoding="utf-8", newline="\n") as file:
            stream = BvhStream(path, frames, file)
            yield stream
        if stream.written != frames:
            raise MapctlError(f"{path}: {stream.written} frames were written, {frames} were announced")


@dataclass(eq=False)
class BvhStream:
    """Takes pieces in turn. The first decides the layout, that of `bvh.save`; rows are the same as there."""

    path: str | PathLike[str]
    """Path of the file, for messages."""
    frames: int
    """Number of frames of the whole motion."""
    file: TextIO
    """The file, open for writing."""
    written: int = 0
    """Number of frames written so far."""
    _tree: Hierarchy | None = field(default=None, repr=False)
    _last: np.ndarray | None = field(default=None, repr=False)

    def append(self, piece: Motion) -> None:
        """Write the next frames; RequestError where they are not finite, MapctlError for another skeleton."""
        bvh.check_finite(piece, self.path)
        layout = bvh_layout.choose_layout(piece, self.path)
        order = [piece.skeleton.index(name) for name in layout.hierarchy.names]
        quat_xyzw = bvh.as_array(piece.local_quat_xyzw)[:, order]
        translations = bvh.all_translations(piece)[:, order] / layout.metres_per_unit
        first = self._tree is None
        tree = self._tree or bvh_layout.fit_hierarchy(layout, translations, quat_xyzw)
        if tree.names != layout.hierarchy.names:
            raise MapctlError(f"{self.path}: a piece has other joints than the first")
        values = self._continue_angles(tree, bvh.channel_values(tree, translations, quat_xyzw))
        text = bvh_text.compose(tree, layout.frame_time, values, decimals=layout.decimals)
        head, frame_time, rows = text.partition(f"Frame Time: {layout.frame_time}\n")
        if first:
            head = head.removesuffix(f"Frames: {len(values)}\n")
            self.file.write(f"{head}Frames: {self.frames}\n{frame_time}")
        self.file.write(rows)
        self._tree, self._last, self.written = tree, values[-1], self.written + len(values)

    def _continue_angles(self, tree: Hierarchy, values: np.ndarray) -> np.ndarray:
        """Return the channels with angles that continue the last piece's as if converted with it."""
        if self._last is None:
            return values
        for axes, _, columns in tree.rotation_groups():
            for joint in np.reshape(columns, (-1, len(axes))):
                values[:, joint] = euler.nearest_equivalent(values[:, joint], self._last[joint], axes)
        return values
