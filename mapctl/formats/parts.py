"""Characters as files have them, in arrays without torch: names, matrices, carriers, polygons and colours.

What is wrong with a file is a `Refusal`, which `names_file` and `sandbox.call` turn into FileFormatError.
"""

import io
import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from fractions import Fraction
from functools import cached_property
from os import PathLike
from pathlib import Path

import numpy as np

from mapctl.errors import FileFormatError
from mapctl.formats.sandbox import Refusal
from mapctl.formats.text import MAX_POSES

Array = np.ndarray
MAX_JOINTS = 4096
"""Most joints of an armature."""
MAX_CORNERS = 2**25
"""Most corners of a mesh's polygons."""
GREY = (0.8, 0.8, 0.8, 1.0)
"""Colour of what has none, sRGB and opacity."""
MOST_CARRIERS = 8
"""Most joints that carry one vertex; weaker ones are left out."""
_MAX_NAMED = 8
_MAX_PIXELS = 2**26
FARTHEST = 1e6
"""Largest coordinate of a joint or a vertex, metres."""
_BONE_SHARE = 0.02  # of a bone's length by which it may differ between bind pose and nodes


@dataclass(frozen=True)
class CharacterPath:
    """A character's file and what is chosen of it."""

    file: Path
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


@contextmanager
def names_file(path: str | PathLike[str]) -> Iterator[None]:
    """Raise FileFormatError, which names the file of a `path`, for a Refusal within."""
    try:
        yield
    except Refusal as refusal:
        raise FileFormatError(parse_character_path(path).file, refusal.args[0]) from None


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


def find_name(file: str, names: Sequence[str], wanted: str | None, what: str) -> int:
    """Return the index of the wanted name; where none is, of the first `animation`, or of the only `armature`.

    Refusal lists the names where none is the wanted one, or several armatures are there: FILE#NAME chooses one.
    """
    listed = ", ".join(repr(name) for name in names[:_MAX_NAMED]) + (" ..." if len(names) > _MAX_NAMED else "")
    if wanted is not None and wanted not in names:
        raise Refusal(f"has no {what} {wanted!r}; it has {listed or 'none'}")
    if wanted is None and what == "armature" and len(names) > 1:
        raise Refusal(f"has {len(names)} armatures: {listed}; choose one, as {file}#{names[0]}")
    return 0 if wanted is None else names.index(wanted)


@dataclass(frozen=True, eq=False)
class NodeTree:
    """The nodes of a file by number. Refusal where they are no tree."""

    children: Mapping[int, Sequence[int]]
    """What is below each node, in the file's order."""

    @cached_property
    def parent(self) -> dict[int, int]:
        """The node that each node is a child of."""
        parent: dict[int, int] = {}
        for node, below in self.children.items():
            for child in below:
                if child not in self.children:
                    raise Refusal(f"has no nodes[{child}], but {len(self.children)}")
                if child in parent:
                    raise Refusal(f"nodes[{child}] has two parents")
                parent[child] = node
        return parent

    def line(self, node: int) -> list[int]:
        """Return a node and all above it, up to the scene."""
        found = [node]
        while found[-1] in self.parent:
            found.append(self.parent[found[-1]])
            if len(found) > MAX_JOINTS:
                raise Refusal(f"nodes[{node}] is below itself, or below more than {MAX_JOINTS} others")
        return found

    def connect(self, nodes: Iterable[int]) -> list[int]:
        """Return these nodes, what lies between them, and their common root, parents first."""
        lines = [self.line(node)[::-1] for node in set(nodes)]
        depth = -1
        for level in zip(*lines, strict=False):
            if len(set(level)) > 1:
                break
            depth += 1
        if depth < 0:
            raise Refusal("joints of one skin have no common node above them")
        wanted = {node for line in lines for node in line[depth:]}
        return [node for node in self.walk(lines[0][depth]) if node in wanted]

    def walk(self, root: int) -> Iterator[int]:
        """Go through a node and all below it, parents first, depth first."""
        waiting = [root]
        while waiting:
            node = waiting.pop()
            yield node
            waiting += reversed(self.children[node])


@dataclass(frozen=True, eq=False)
class Armature:
    """A connected tree of nodes that are one character's joints."""

    name: str
    """Name by which it is chosen."""
    nodes: Sequence[int]
    """Numbers of its nodes, parents first; the first is the root."""
    parents: tuple[int, ...]
    """Index among `nodes` of each one's parent, -1 for the root."""
    ends: dict[int, int]
    """Number of the node that is the End Site of a last joint, by that joint's index among `nodes`."""
    skins: Sequence[int] = ()
    """Skins that it carries, where the format numbers them."""


def choose_armature(
    path: str | PathLike[str], armatures: Sequence[Armature], wanted: str | None
) -> tuple[list[str], Armature]:
    """Return the armatures' names, unique, and the wanted one, as `find_name` does."""
    names = make_unique([armature.name for armature in armatures])
    number = find_name(Path(path).name, names, wanted, "armature")
    return names, replace(armatures[number], name=names[number])


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
    """A character's joints in a file, and what was read of them. The world is in metres, with Y up."""

    armature: str
    """Name by which the character is chosen."""
    armatures: list[str]
    """Names of all in the file."""
    names: list[str]
    """Names of the joints, unique, parents first."""
    nodes: Sequence[int | str]
    """By joint what the file calls it."""
    parents: tuple[int, ...]
    """Index of each one's parent, -1 for the root."""
    metres_per_unit: float
    """Length of the unit that the file declares, metres."""
    worlds: Array
    """(joints, 4, 4) world matrices at rest."""
    outer: Array
    """(4, 4) what takes the frame that the root is in to the world."""
    ends: dict[int, Array] = field(default_factory=dict)
    """(4, n) whose last column is the tip of a last joint in its frame, by joint."""
    humanoid: dict[str, str] = field(default_factory=dict)
    """Joint by canonical name, where the file itself maps them (VRM)."""
    licence: str = ""
    fault: str = ""
    """Fault of the meshes; empty without one."""
    animations: dict[str, float] = field(default_factory=dict)
    """Seconds by name of the animations that fit the character; empty unless its motion was read."""
    animation: str | None = None
    motion: tuple[Fraction, Array] | None = None
    """Frames per second, and world matrices (frames, joints, 4, 4)."""
    parts: list[MeshPart] = field(default_factory=list)
    """Its triangles; empty unless they were read."""


class UnevenScaleError(Refusal):
    """A matrix stretches by different factors along its axes, mirrors, or shears."""


def check_size(*tables: Array) -> None:
    """Refuse matrices (..., 4, 4) that are not finite and within 1000 km."""
    for table in tables:
        if not np.isfinite(table).all() or np.abs(table).max(initial=0.0) > FARTHEST:
            raise Refusal("its joints are at positions that are not finite, or larger than 1000 km")


def check_poses(frames: float, joints: int) -> None:
    """Refuse so many frames and joints where their poses would fill the memory."""
    if frames * joints > MAX_POSES:
        raise Refusal(f"{frames:.0f} frames of {joints} joints, allowed are {MAX_POSES} in all")


def compose_matrices(translations: Array, quat_xyzw: Array, scales: Array) -> Array:
    """Return matrices (..., 4, 4) that scale by (..., 3), then turn by (..., 4), then move by (..., 3). A quaternion of
    length zero does not turn."""
    unit = quat_xyzw / np.maximum(np.linalg.norm(quat_xyzw, axis=-1, keepdims=True), 1e-9)
    across = -np.cross(unit[..., None, :3], np.eye(3))  # the matrix of a product with the vector part, by rows
    turns = np.eye(3) + 2 * (unit[..., 3:, None] * across + across @ across)
    matrices = np.zeros((*turns.shape[:-2], 4, 4))
    matrices[..., :3, :3] = turns * scales[..., None, :]
    matrices[..., :3, 3] = translations
    matrices[..., 3, 3] = 1.0
    return matrices


def compose_transforms(transforms: Array) -> Array:
    """Return matrices (..., 4, 4) of translation, rotation xyzw and scale (..., 10). Refusal where they are not finite,
    or larger than 1000 km."""
    if not np.isfinite(transforms).all() or np.abs(transforms).max(initial=0.0) > FARTHEST:
        raise Refusal("its animation holds numbers that are not finite, or larger than 1000 km")
    if np.linalg.norm(transforms[..., 3:7], axis=-1).min(initial=1.0) < 1e-6:
        raise Refusal("its animation holds a rotation of length zero")
    return compose_matrices(transforms[..., :3], transforms[..., 3:7], transforms[..., 7:])


def chain_matrices(parents: Sequence[int], local: Array, outer: Array) -> Array:
    """Return world matrices (..., joints, 4, 4) of local ones; `outer` (..., 4, 4) takes the root's frame to the world.
    Refusal as of `check_size`."""
    worlds = np.empty_like(local)
    with np.errstate(all="ignore"):
        for joint, parent in enumerate(parents):
            worlds[..., joint, :, :] = (outer if parent < 0 else worlds[..., parent, :, :]) @ local[..., joint, :, :]
    check_size(worlds)
    return worlds


def split_scales(parents: Sequence[int], worlds: Array, names: Sequence[str] = ()) -> tuple[Array, Array]:
    """Return rotations (joints, 3, 3) and scales (joints,) of world matrices (joints, 4, 4).

    UnevenScaleError names a joint that is stretched; but last joints, in whose frames no other is, may mirror.
    """
    turns, scales = np.empty((len(parents), 3, 3)), np.empty(len(parents))
    for joint, matrix in enumerate(worlds):
        try:
            turns[joint], scales[joint] = split_scale(matrix, may_mirror=joint not in parents)
        except UnevenScaleError as error:
            name = names[joint] if names else joint
            raise UnevenScaleError(f"joint {name}: {error.args[0]}") from None
    return turns, scales


def split_scale(matrix: Array, *, may_mirror: bool = False) -> tuple[Array, float]:
    """Return rotation (3, 3) and scale of a (4, 4) matrix that turns and scales alike along all axes.

    UnevenScaleError where it does not: where it stretches, mirrors or shears by more than a thousandth. One that
    `may_mirror` has a negative scale where it does.
    """
    linear, sign = matrix[:3, :3], 1.0
    if may_mirror and np.linalg.det(linear) < 0:
        linear, sign = -linear, -1.0
    lengths = np.linalg.norm(linear, axis=0)
    scale = float(np.cbrt(abs(np.linalg.det(linear))))
    if not scale > 1e-9:
        raise UnevenScaleError("its scale is zero; apply it and export again")
    if np.linalg.det(linear) < 0:
        raise UnevenScaleError("its scale is negative, which mirrors; apply it and export again")
    if not np.allclose(lengths, scale, rtol=1e-3) or not np.allclose(
        linear.T @ linear, scale**2 * np.eye(3), atol=2e-3 * scale**2
    ):
        sizes = ", ".join(f"{length:.4g}" for length in lengths)
        raise UnevenScaleError(f"its scale is not the same along all axes ({sizes}); apply it and export again")
    return nearest_rotations(linear), sign * scale


def nearest_rotations(linear: Array) -> Array:
    """Return the rotations (..., 3, 3) nearest to matrices (..., 3, 3), by singular values."""
    left, _, right = np.linalg.svd(linear)
    flip = np.ones(linear.shape[:-1])
    flip[..., -1] = np.linalg.det(left @ right)
    return (left * flip[..., None, :]) @ right


def complete_bind_pose(
    parents: Sequence[int], candidates: Iterable[Mapping[int, Array]], worlds: Array
) -> Array | None:
    """Return world matrices (joints, 4, 4) of the first candidate, a bind pose of matrices (4, 4) by joint, whose bones
    are as long as the nodes' and joints scaled like them; joints that it leaves out are as the nodes', (joints, 4, 4).
    None where there is none."""
    return next((done for bound in candidates if (done := _complete(parents, bound, worlds)) is not None), None)


def _complete(parents: Sequence[int], bound: Mapping[int, Array], worlds: Array) -> Array | None:
    done = np.empty_like(worlds)
    for joint, parent in enumerate(parents):
        above = np.eye(4) if parent < 0 else done[parent]
        own = worlds[joint] if parent < 0 else np.linalg.pinv(worlds[parent]) @ worlds[joint]
        done[joint] = bound.get(joint, above @ own)
        if parent >= 0:
            length, usual = (np.linalg.norm(w[joint][:3, 3] - w[parent][:3, 3]) for w in (done, worlds))
            if abs(length - usual) > _BONE_SHARE * max(usual, 0.02):
                return None
    try:
        scales = split_scales(parents, done)[1] / split_scales(parents, worlds)[1]
    except UnevenScaleError:
        return None
    return done if np.allclose(scales, 1.0, rtol=1e-2) else None


def strongest(vertices: Array, carriers: Array, weights: Array, count: int) -> tuple[Array, Array]:
    """Return tables (count, k) of the strongest carriers of each vertex and their shares, of triples in any order.

    Vertices without any are carried by 0 alone.
    """
    kept = (weights > 0) & np.isfinite(weights) & (vertices >= 0) & (vertices < count)
    vertices, carriers, weights = vertices[kept], carriers[kept], weights[kept]
    order = np.lexsort((-weights, vertices))
    vertices, carriers, weights = vertices[order], carriers[order], weights[order]
    rank = np.arange(len(vertices)) - np.searchsorted(vertices, vertices)
    width = int(min(rank.max(initial=0) + 1, MOST_CARRIERS))
    rows, shares = np.zeros((count, width), np.int64), np.zeros((count, width))
    near = rank < width
    rows[vertices[near], rank[near]] = carriers[near]
    shares[vertices[near], rank[near]] = weights[near]
    return rows, share_out(shares)


def share_out(weights: Array) -> Array:
    """Divide weights (n, k) by their sums; a vertex without any is the first carrier's."""
    total = weights.sum(axis=1, keepdims=True)
    weights[total[:, 0] <= 0, 0] = 1.0
    return weights / np.where(total > 0, total, 1.0)


def split_polygons(counts: Array, skipped: Array | None = None) -> tuple[Array, Array]:
    """Return triangles (m, 3) as indices of corners, each polygon a fan around its first corner, and (m,) the polygon
    that each is of. `counts` (polygons,) are their numbers of corners; polygons with fewer than 3, and those of
    `skipped` (polygons,), have none."""
    starts = np.cumsum(counts) - counts
    triangles = np.maximum(counts - 2, 0)
    if skipped is not None:
        triangles = np.where(skipped, 0, triangles)
    polygon = np.repeat(np.arange(len(counts)), triangles)
    number = np.arange(len(polygon)) - np.repeat(np.cumsum(triangles) - triangles, triangles)
    first = starts[polygon]
    return np.stack([first, first + number + 1, first + number + 2], axis=1), polygon


def mean_at_vertices(corners: Array, vertices: Array, count: int) -> Array:
    """Return the mean (count, width) of values at corners (n, width) of `vertices` (n,); 0.8 of one without corners."""
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
    """Return the picture's colours (n, 4), sRGB and opacity, 0 to 1, at positions (n, 2): from its upper left corner, 1
    at the other sides, and repeated beyond."""
    height, width = picture.shape[:2]
    column = np.floor(np.mod(where[:, 0], 1.0) * width).astype(int).clip(0, width - 1)
    row = np.floor(np.mod(where[:, 1], 1.0) * height).astype(int).clip(0, height - 1)
    return picture[row, column] / 255.0
