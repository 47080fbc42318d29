"""The triangles of a glTF character that its armature carries, in the rest pose, with their colours."""

from dataclasses import dataclass, replace
from os import PathLike

import numpy as np

from mapctl.errors import FileFormatError
from mapctl.formats.character import RestFrames
from mapctl.formats.gltf.document import GltfFile, Json, read_accessor, read_neighbour, read_view, refuse_malformed
from mapctl.formats.gltf.reader import (
    Armature,
    NodeTree,
    node_matrix,
    open_character,
    read_inverse_binds,
    read_skeleton,
)
from mapctl.formats.parts import decode_picture, decode_srgb, encode_srgb, sample_picture
from mapctl.mesh.character_mesh import (
    MOST_CELLS,
    CharacterMesh,
    Refinement,
    choose_cell,
    compute_normals,
    merge_meshes,
    refine,
)

Array = np.ndarray
_TRIANGLES, _STRIP, _FAN = 4, 5, 6
_MAX_VERTICES = 2**23


@dataclass(frozen=True, eq=False)
class Paint:
    """What gives a primitive its colours."""

    linear: Array
    """(n, 4) factor at each vertex in proportion to light, and opacity."""
    places: Array | None
    """(n, 2) where in the picture vertices are, 0 to 1 across and down; None without a picture."""
    picture: Array | None
    """(height, width, 4) sRGB, 0 to 255."""
    blended: bool
    """Whether one sees through what is not opaque."""

    def colours(self, corners: Array, shares: Array) -> Array:
        """Return the colours (n, 4), sRGB and opacity, 0 to 1, of points on triangles: see `refinement.Paint`."""
        linear = np.einsum("nc,nck->nk", shares, self.linear[corners])
        light = linear[:, :3]
        if self.places is not None and self.picture is not None:
            texels = sample_picture(self.picture, np.einsum("nc,nck->nk", shares, self.places[corners]))
            light, linear[:, 3] = light * decode_srgb(texels[:, :3]), linear[:, 3] * texels[:, 3]
        rgba = np.column_stack([encode_srgb(light), linear[:, 3]])
        if not self.blended:
            rgba[:, 3] = 1.0
        return rgba.clip(0.0, 1.0)

    def at_vertices(self) -> Array:
        """Return the colours of the vertices, (n, 4)."""
        corners = np.repeat(np.arange(len(self.linear))[:, None], 3, axis=1)
        return self.colours(corners, np.tile([1.0, 0.0, 0.0], (len(corners), 1)))

    def coarsen(self, vertices: Array, faces: Array, cell: float) -> "Paint":
        """Average what of the picture lies within cells of this length, metres, on the triangles, so that points
        between which there is more show no noise."""
        if self.picture is None or self.places is None:
            return self
        size = np.array(self.picture.shape[1::-1])
        corners, inside = vertices[faces], size * self.places[faces]
        lengths, texels = (np.linalg.norm(at - np.roll(at, 1, axis=1), axis=2).sum() for at in (corners, inside))
        factor = int(min(cell * texels / max(lengths, 1e-9), *(size / 4)))
        return self if factor < 2 else replace(self, picture=_shrink(self.picture, factor))


class _Palette:
    """What takes the vertices of a mesh to the rest pose, by index in JOINTS_0."""

    def __init__(self, joints: Array, matrices: Array, *, rigid: bool):
        self.joints, self.matrices, self.rigid = joints, matrices, rigid


@refuse_malformed
def load_mesh(path: str | PathLike[str]) -> CharacterMesh:
    """Read the mesh of a character: what its skins carry, and what hangs on its joints rigidly. `path` chooses as in
    `load`. FileFormatError where the file has no triangles for the armature, or they are broken."""
    _, gltf, armature = open_character(path)
    frames, _ = read_skeleton(gltf, armature)
    return read_mesh(gltf, armature, frames)


def read_mesh(gltf: GltfFile, armature: Armature, frames: RestFrames) -> CharacterMesh:
    """Read the mesh of an armature whose rest frames are known."""
    tree, place = NodeTree(gltf), {node: joint for joint, node in enumerate(armature.nodes)}
    found: list[CharacterMesh] = []
    for number, node in enumerate(gltf.all("nodes")):
        mesh, skin = node.get("mesh"), node.get("skin")
        if mesh is None:
            continue
        if skin is not None and skin in armature.skins:
            palette = _skin_palette(gltf, armature, frames, skin)
        else:
            above = next((above for above in tree.line(number) if above in place), None)
            if above is None or skin is not None:
                continue
            palette = _rigid_palette(gltf, tree, frames, number, place[above], above)
        for k, primitive in enumerate(gltf.get("meshes", mesh).get("primitives", ())):
            what = f"meshes[{mesh}].primitives[{k}]"
            if primitive.get("mode", 4) in (_TRIANGLES, _STRIP, _FAN) and "POSITION" in primitive["attributes"]:
                found.append(_read_primitive(gltf, primitive, palette, frames, what))
    if not found:
        raise FileFormatError(gltf.path, f"armature {armature.name!r} carries no triangles")
    return merge_meshes(found)


def _skin_palette(gltf: GltfFile, armature: Armature, frames: RestFrames, skin: int) -> _Palette:
    place = {node: joint for joint, node in enumerate(armature.nodes)}
    joints = np.array([place[node] for node in gltf.get("skins", skin)["joints"]])
    inverse = read_inverse_binds(gltf, skin)
    inverse = np.tile(np.eye(4), (len(joints), 1, 1)) if inverse is None else inverse
    return _Palette(joints, frames.matrices()[joints] @ inverse, rigid=False)


def _rigid_palette(gltf: GltfFile, tree: NodeTree, frames: RestFrames, node: int, joint: int, above: int) -> _Palette:
    matrix = np.eye(4)
    line = tree.line(node)
    for below in reversed(line[: line.index(above)]):
        matrix = matrix @ node_matrix(gltf.get("nodes", below))
    return _Palette(np.array([joint]), (frames.matrices()[joint] @ matrix)[None], rigid=True)


def _read_primitive(gltf: GltfFile, primitive: Json, palette: _Palette, frames: RestFrames, what: str) -> CharacterMesh:
    points = read_accessor(gltf, primitive["attributes"]["POSITION"], "VEC3").astype(np.float64)
    if len(points) > _MAX_VERTICES:
        raise FileFormatError(gltf.path, f"{what} has {len(points)} vertices, allowed are {_MAX_VERTICES}")
    joints, weights = _read_carriers(gltf, primitive, palette, len(points), what)
    blend = np.zeros((len(points), 4, 4))
    for joint, weight in zip(joints.T, weights.T, strict=True):
        blend += weight[:, None, None] * palette.matrices[joint]
    vertices = np.einsum("nab,nb->na", blend[:, :3, :3], points) + blend[:, :3, 3]
    faces = _read_faces(gltf, primitive, len(points), what)
    rgba, fine = _read_colours(gltf, primitive, vertices, faces, what)
    return CharacterMesh(
        vertices=vertices,
        normals=compute_normals(vertices, faces),
        faces=faces,
        rgba=rgba,
        joints=palette.joints[joints],
        weights=weights,
        rest=frames.positions,
        fine=fine,
    )


def _read_colours(
    gltf: GltfFile, primitive: Json, vertices: Array, faces: Array, what: str
) -> tuple[Array, Refinement | None]:
    """Return the vertices' colours, and finer triangles where a picture shows more than these can."""
    paint = read_paint(gltf, primitive, len(vertices), what)
    if paint.picture is None or not len(faces):
        return paint.at_vertices(), None
    share = MOST_CELLS // sum(len(mesh.get("primitives", ())) for mesh in gltf.all("meshes"))
    wrong, cell = choose_cell(vertices, faces, paint.colours, share)
    if not wrong.any():
        return paint.at_vertices(), None
    paint = paint.coarsen(vertices, faces, cell)
    return paint.at_vertices(), refine(vertices, faces, wrong, cell, paint.colours)


def _read_carriers(gltf: GltfFile, primitive: Json, palette: _Palette, count: int, what: str) -> tuple[Array, Array]:
    """Return by vertex the indices in the palette and their shares, (n, k) each."""
    if palette.rigid:
        return np.zeros((count, 1), np.int64), np.ones((count, 1))
    joints, weights = [], []
    for number in range(4):
        if f"JOINTS_{number}" in primitive["attributes"] and f"WEIGHTS_{number}" in primitive["attributes"]:
            joints.append(read_accessor(gltf, primitive["attributes"][f"JOINTS_{number}"], "VEC4"))
            weights.append(read_accessor(gltf, primitive["attributes"][f"WEIGHTS_{number}"], "VEC4").astype(np.float64))
    if not joints:
        raise FileFormatError(gltf.path, f"{what} has a skin and no JOINTS_0 and WEIGHTS_0")
    own, shares = np.concatenate(joints, axis=1).astype(np.int64), np.concatenate(weights, axis=1)
    if own.shape != shares.shape or len(own) != count:
        raise FileFormatError(gltf.path, f"{what} has {count} vertices and {len(own)} rows of joints")
    own = np.where(shares > 0, own, 0)
    if own.min() < 0 or own.max() >= len(palette.joints):
        raise FileFormatError(gltf.path, f"{what} names joint {own.max()} of a skin of {len(palette.joints)}")
    total = shares.sum(axis=1, keepdims=True)
    shares[total[:, 0] <= 0, 0] = 1.0
    return own, shares / np.where(total > 0, total, 1.0)


def _read_faces(gltf: GltfFile, primitive: Json, count: int, what: str) -> Array:
    order = (
        np.arange(count)
        if primitive.get("indices") is None
        else read_accessor(gltf, primitive["indices"], "SCALAR")[:, 0]
    )
    order = order.astype(np.int64)
    if len(order) and (order.min() < 0 or order.max() >= count):
        raise FileFormatError(gltf.path, f"{what} names vertex {order.max()} of {count}")
    mode = primitive.get("mode", 4)
    if mode == _TRIANGLES:
        return order[: len(order) // 3 * 3].reshape(-1, 3)
    if mode == _STRIP:
        faces = np.stack([order[:-2], order[1:-1], order[2:]], axis=1)
        faces[1::2] = faces[1::2, ::-1]
        return faces
    return np.stack([np.full(max(len(order) - 2, 0), order[0]), order[1:-1], order[2:]], axis=1)


def read_paint(gltf: GltfFile, primitive: Json, count: int, what: str) -> Paint:
    """Read what gives a primitive of `count` vertices its colours.

    Without the package pillow, or of a kind that it does not know, a picture's place is taken by the material's plain
    colour.
    """
    material = {} if primitive.get("material") is None else gltf.get("materials", primitive["material"])
    look, blended = material.get("pbrMetallicRoughness", {}), material.get("alphaMode") == "BLEND"
    linear = np.tile(np.array(look.get("baseColorFactor", (1.0, 1.0, 1.0, 1.0)), np.float64), (count, 1))
    if "COLOR_0" in primitive["attributes"]:
        own = read_accessor(gltf, primitive["attributes"]["COLOR_0"], "VEC3", "VEC4").astype(np.float64)
        if len(own) != count:
            raise FileFormatError(gltf.path, f"{what} has {count} vertices and {len(own)} colours")
        linear[:, : own.shape[1]] *= own
    texture = look.get("baseColorTexture")
    shown = None if texture is None else _read_shown(gltf, primitive, texture, count)
    places, picture = (None, None) if shown is None else shown
    return Paint(linear, places, picture, blended)


def _read_shown(gltf: GltfFile, primitive: Json, info: Json, count: int) -> tuple[Array, Array] | None:
    """Return where the vertices are in the picture, and the picture; None where it cannot be read."""
    name = f"TEXCOORD_{info.get('texCoord', 0)}"
    if name not in primitive["attributes"]:
        return None
    picture = _read_picture(gltf, info["index"])
    if picture is None:
        return None
    where = read_accessor(gltf, primitive["attributes"][name], "VEC2").astype(np.float64)
    if len(where) != count:
        raise FileFormatError(gltf.path, f"{name} has {len(where)} rows for {count} vertices")
    return where, picture


def _shrink(picture: Array, factor: int) -> Array:
    """Average squares of so many texels; what is left over at the edges counts as the last square's."""
    height, width = (side // factor for side in picture.shape[:2])
    squares = picture[: height * factor, : width * factor].reshape(height, factor, width, factor, 4)
    return squares.mean(axis=(1, 3))


def _read_picture(gltf: GltfFile, texture: int) -> Array | None:
    source = gltf.get("textures", texture).get("source")
    if source is None:
        return None
    image = gltf.get("images", source)
    if image.get("uri") is not None:
        return decode_picture(read_neighbour(gltf.path, image["uri"]))
    return None if image.get("bufferView") is None else decode_picture(bytes(read_view(gltf, image["bufferView"])))
