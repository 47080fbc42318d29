"""Motion files with NaN where something was lost, and with more channels than a motion needs."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from mapctl.formats import bvh
from mapctl.motion import Motion

GOOD = """HIERARCHY
ROOT hips
{
  OFFSET 0 0 0
  CHANNELS 6 Xposition Yposition Zposition Zrotation Xrotation Yrotation
  JOINT leg
  {
    OFFSET 10 0 0
    CHANNELS 3 Zrotation Xrotation Yrotation
    End Site
    {
      OFFSET 0 0 10
    }
  }
}
MOTION
Frames: 3
Frame Time: 0.0333333
1 90 3 10 20 30 1 2 3
2 91 4 11 21 31 2 3 4
3 92 5 12 22 32 3 4 5
"""
"""A whole BVH file: two joints, three frames."""


def without(source: Path, out: Path, lost: Sequence[tuple[str, int, int]], *, word: str = "nan") -> Path:
    """The BVH file with a word in place of the values of channels whose label begins so, from a frame up to another."""
    read = bvh.read(source, lossy=False)[0].source
    lines = source.read_text().splitlines()
    first = next(number for number, line in enumerate(lines) if line.startswith("Frame Time")) + 1
    rows = [row.split() for row in lines[first:]]
    for label, start, stop in lost:
        columns = [position for position, name in enumerate(read.hierarchy.labels()) if name.startswith(label)]
        assert columns
        for frame in range(start, stop):
            for column in columns:
                rows[frame][column] = word
    out.write_text("\n".join([*lines[:first], *map(" ".join, rows)]) + "\n")
    return out


def archive_without(source: Path, out: Path, **lost: tuple[object, ...]) -> Path:
    """The npz with NaN at these places of its keys."""
    with np.load(source) as read:
        arrays = dict(read)
    for key, position in lost.items():
        arrays[key][position] = np.nan
    np.savez(out, allow_pickle=False, **arrays)
    return out


def with_all_channels(motion: Motion, out: Path, *, seed: int | None = None) -> Path:
    """The motion as BVH with six channels on every joint, in Euler orders that the seed draws."""
    draw = np.random.default_rng(seed)
    motion.save(out)
    read = bvh.read(out, lossy=False)[0].source
    orders = [("Z", "X", "Y") if seed is None else tuple(draw.permutation(list("XYZ"))) for _ in motion.skeleton.names]
    channels = tuple((*bvh.POSITIONS, *(f"{axis}rotation" for axis in order)) for order in orders)
    tree = replace(read.hierarchy, channels=channels)
    order = [motion.skeleton.index(name) for name in tree.names]
    positions, turns = 100 * bvh.all_translations(motion)[:, order], bvh.as_array(motion.local_quat_xyzw)[:, order]
    values = bvh.channel_values(tree, positions, turns)
    out.write_text(bvh.compose(tree, read.frame_time, values, decimals=6))
    return out
