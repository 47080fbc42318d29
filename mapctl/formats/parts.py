"""Characters and their triangles as files have them: names, carriers, polygons and colours, in arrays without torch."""

import io
import os
from collections.abc import Sequence
from dataclasses import dataclass, field
from os import PathLike
from pathlib import Path

import numpy as np

from mapctl.formats.sandbox import Refusal

Array = np.ndarray
_MAX_NAMED = 8
MOST_CARRIERS = 8
"""Most joints that carry one vertex; weaker ones are left out."""
_MAX_PIXELS = 2**26


@dataclass(frozen=True)
class CharacterPath:
    """A character's file and what is chosen of it."""

    file: Path
    """The file."""
    armature: str | None = None
    """Name of the armature; None where the file has one."""
    animation: str | None = None
    """Name of the animation; None for the first."""


def parse_character_path(path: str | PathLike[str]) -> CharacterPath:
    """Split FILE#ARMATURE/ANIMATION; a file whose own name holds a # is taken as it is if it exists."""
    text = os.fspath(path)
    name, mark, choice = text.rpartition("#")
    if not mark or Path(text).exists():
        return CharacterPath(Path(text))
    armature, _, animation = choice.partition("/")
    return CharacterPath(Path(name), armature or None, animation or None)


def make_unique(names: Sequence[str]) -> list[str]:
    """Return the names in order, each later one of several alike with `_2`, `_3`, ..."""
    taken: set[str] = set()
    found = []
    for name in names:
        candidate, number = name, 2
        while candidate in taken or (candidate != name and candidate in names):
            candidate, number = f"{name}_{number}", number + 1
        taken.add(candidate)
        found.append(candidate)
    return found


def find_name(file: str, names: Sequence[str], wanted: str | None, what: str, *, several: bool) -> int:
    """Return the index of the wanted name, or of the only or first one; `what` is `armature` or `animation`.

    Refusal lists the names where none is the wanted one, or several are there and one must be chosen: FILE#NAME.
    """
    listed = ", ".join(repr(name) for name in names[:_MAX_NAMED]) + (" ..." if len(names) > _MAX_NAMED else "")
    example = f"{file}#{names[0] if what == 'armature' else '/' + names[0]}" if names else ""
    if wanted is not None:
        if wanted in names:
            return names.index(wanted)
        raise Refusal(f"has no {what} {wanted!r}; it has {listed or 'none'}")
    if len(names) > 1 and not several:
        raise Refusal(f"has {len(names)} {what}s: {listed}; choose one, as {example}")
    return 0


@dataclass(frozen=True, eq=False)
class MeshPart:
    """Triangles with one table of what carries them."""

    points: Array
    """(n, 3) vertices in the mesh's own frame."""
    faces: Array
    """(m, 3) vertex indices, counter-clockwise seen from outside."""
    rgba: Array
    """(n, 4) sRGB colour and opacity, 0 to 1."""
    joints: Array
    """(p,) indices of joints."""
    matrices: Array
    """(p, 4, 4) from the mesh's frame to the joint's, as at the time of binding."""
    rows: Array
    """(n, k) indices in `joints` of what carries a vertex."""
    shares: Array
    """(n, k) how much; each vertex's add up to 1."""


@dataclass(eq=False, kw_only=True)
class FoundCharacter:
    """A character's joints in a file, and what was read of them."""

    armature: str
    """Name by which the character is chosen."""
    armatures: list[str]
    """Names of all in the file."""
    names: list[str]
    """Names of the joints, unique, parents first."""
    parents: list[int]
    """Index of each one's parent, -1 where it has none."""
    metres_per_unit: float
    """Length of the unit that the file declares, metres."""
    animations: dict[str, float] = field(default_factory=dict)
    """Seconds by name of the animations that fit the character; empty unless its motion was read."""
    animation: str | None = None
    """Name of the animation that was read."""
    parts: list[MeshPart] = field(default_factory=list)
    """Its triangles; empty unless they were read."""


def strongest(vertices: Array, carriers: Array, weights: Array, count: int) -> tuple[Array, Array]:
    """Return tables (count, k) of the strongest carriers of each vertex and their shares, of triples in any order.

    Vertices without any are carried by 0 alone.
    """
    kept = (weights > 0) & np.isfinite(weights) & (vertices >= 0) & (vertices < count)
    vertices, carriers, weights = vertices[kept], carriers[kept], weights[kept]
    order = np.lexsort((-weights, vertices))
    vertices, carriers, weights = vertices[order], carriers[order], weights[order]
    first = np.searchsorted(vertices, vertices)
    rank = np.arange(len(vertices)) - first
    width = int(min(rank.max(initial=0) + 1, MOST_CARRIERS))
    rows, shares = np.zeros((count, width), np.int64), np.zeros((count, width))
    near = rank < width
    rows[vertices[near], rank[near]] = carriers[near]
    shares[vertices[near], rank[near]] = weights[near]
    total = shares.sum(axis=1, keepdims=True)
    shares[total[:, 0] <= 0, 0] = 1.0
    return rows, shares / np.where(total > 0, total, 1.0)


def split_polygons(counts: Array, skipped: Array | None = None) -> tuple[Array, Array]:
    """Return triangles (m, 3) as indices of corners, each polygon a fan around its first corner, and (m,) the polygon
    that each is of. `counts` (polygons,) are their numbers of corners; polygons with fewer than 3, and those of
    `skipped` (polygons,), have none."""
    counts = np.asarray(counts, np.int64)
    starts = np.concatenate([[0], np.cumsum(counts)[:-1]]) if len(counts) else counts
    triangles = np.maximum(counts - 2, 0)
    if skipped is not None:
        triangles = np.where(skipped, 0, triangles)
    polygon = np.repeat(np.arange(len(counts)), triangles)
    number = np.arange(len(polygon)) - np.repeat(np.cumsum(triangles) - triangles, triangles)
    first = starts[polygon]
    return np.stack([first, first + number + 1, first + number + 2], axis=1), polygon


def mean_at_vertices(corners: Array, vertices: Array, count: int) -> Array:
    """Return the mean (count, width) of values at corners (n, width), which belong to `vertices` (n,); a vertex without
    corners has 0.8."""
    total, number = np.zeros((count, corners.shape[1])), np.zeros(count)
    np.add.at(total, vertices, corners)
    np.add.at(number, vertices, 1.0)
    return np.where(number[:, None] > 0, total / np.maximum(number, 1.0)[:, None], 0.8)


def encode_srgb(linear: Array) -> Array:
    """Return sRGB of colours that are in proportion to light, 0 to 1."""
    linear = np.clip(linear, 0.0, 1.0)
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)


def decode_srgb(srgb: Array) -> Array:
    """Undo `encode_srgb`."""
    return np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)


def decode_picture(data: bytes) -> Array | None:
    """Return a picture's pixels (height, width, 4), 0 to 255; None without the package pillow, for kinds that it does
    not know, and for pictures that are broken or huge."""
    try:
        from PIL import Image
    except ImportError:  # the extra `render` is not installed, and nothing will be drawn
        return None
    try:
        with Image.open(io.BytesIO(data)) as opened:
            if opened.width * opened.height > _MAX_PIXELS:
                return None
            return np.asarray(opened.convert("RGBA"))
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError):
        return None


def sample_picture(picture: Array, where: Array) -> Array:
    """Return the picture's colours (n, 4), sRGB and opacity, 0 to 1, at places (n, 2): from its upper left corner, 1 at
    the other sides, and repeated beyond."""
    height, width = picture.shape[:2]
    column = np.floor(np.mod(where[:, 0], 1.0) * width).astype(int).clip(0, width - 1)
    row = np.floor(np.mod(where[:, 1], 1.0) * height).astype(int).clip(0, height - 1)
    return picture[row, column] / 255.0
