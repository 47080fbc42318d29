"""The triangles of a glTF character that its armature carries, in the rest pose, with a colour at every vertex."""

from os import PathLike

import numpy as np

from mapctl.errors import FileFormatError
from mapctl.formats.characters.rest_frames import RestFrames
from mapctl.formats.gltf.accessors import read_accessor
from mapctl.formats.gltf.armatures import Armature, NodeTree, node_matrix
from mapctl.formats.gltf.container import GltfFile
from mapctl.formats.gltf.materials import read_paint
from mapctl.formats.gltf.reader import open_character, read_skeleton
from mapctl.formats.gltf.schema import Primitive
from mapctl.mesh.character_mesh import CharacterMesh, compute_normals, merge_meshes
from mapctl.mesh.refinement import MOST_CELLS, Refinement, choose_cell, refine

Array = np.ndarray
_TRIANGLES, _STRIP, _FAN = 4, 5, 6
_MAX_VERTICES = 2**23


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
    for number, node in enumerate(gltf.document.nodes):
        if node.mesh is None or node.mesh >= len(gltf.document.meshes):
            continue
        if node.skin is not None and node.skin in armature.skins:
            palette = _skin_palette(gltf, armature, frames, node.skin)
        else:
            above = next((above for above in tree.line(number) if above in place), None)
            if above is None or node.skin is not None:
                continue
            palette = _rigid_palette(gltf, tree, frames, number, place[above], above)
        for k, primitive in enumerate(gltf.document.meshes[node.mesh].primitives):
            what = f"meshes[{node.mesh}].primitives[{k}]"
            if primitive.mode in (_TRIANGLES, _STRIP, _FAN) and "POSITION" in primitive.attributes:
                found.append(_read_primitive(gltf, primitive, palette, frames, what))
    if not found:
        raise FileFormatError(gltf.path, f"armature {armature.name!r} carries no triangles")
    return merge_meshes(found)


class _Palette:
    """What takes the vertices of a mesh to the rest pose, by index in JOINTS_0."""

    def __init__(self, joints: Array, matrices: Array, *, rigid: bool):
        self.joints, self.matrices, self.rigid = joints, matrices, rigid


def _skin_palette(gltf: GltfFile, armature: Armature, frames: RestFrames, skin: int) -> _Palette:
    said, worlds = gltf.document.skins[skin], frames.matrices()
    place = {node: joint for joint, node in enumerate(armature.nodes)}
    joints = np.array([place[node] for node in said.joints])
    inverse = np.tile(np.eye(4), (len(joints), 1, 1))
    if said.inverseBindMatrices is not None:
        inverse = read_accessor(gltf, said.inverseBindMatrices, "MAT4").reshape(-1, 4, 4).transpose(0, 2, 1)
        if len(inverse) < len(joints):
            what = f"skins[{skin}] has {len(joints)} joints and {len(inverse)} inverse bind matrices"
            raise FileFormatError(gltf.path, what)
    return _Palette(joints, worlds[joints] @ inverse[: len(joints)], rigid=False)


def _rigid_palette(gltf: GltfFile, tree: NodeTree, frames: RestFrames, node: int, joint: int, above: int) -> _Palette:
    matrix = np.eye(4)
    line = tree.line(node)
    for below in reversed(line[: line.index(above)]):
        matrix = matrix @ node_matrix(gltf.document.nodes[below])
    return _Palette(np.array([joint]), (frames.matrices()[joint] @ matrix)[None], rigid=True)


def _read_primitive(
    gltf: GltfFile, primitive: Primitive, palette: _Palette, frames: RestFrames, what: str
) -> CharacterMesh:
    points = read_accessor(gltf, primitive.attributes["POSITION"], "VEC3").astype(np.float64)
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
    gltf: GltfFile, primitive: Primitive, vertices: Array, faces: Array, what: str
) -> tuple[Array, Refinement | None]:
    """Return the vertices' colours, and finer triangles where a picture shows more than these can."""
    paint = read_paint(gltf, primitive, len(vertices), what)
    if paint.picture is None or not len(faces):
        return paint.at_vertices(), None
    share = MOST_CELLS // sum(len(mesh.primitives) for mesh in gltf.document.meshes)
    wrong, cell = choose_cell(vertices, faces, paint.colours, share)
    if not wrong.any():
        return paint.at_vertices(), None
    paint = paint.coarsen(vertices, faces, cell)
    return paint.at_vertices(), refine(vertices, faces, wrong, cell, paint.colours)


def _read_carriers(
    gltf: GltfFile, primitive: Primitive, palette: _Palette, count: int, what: str
) -> tuple[Array, Array]:
    """Return by vertex the indices in the palette and their shares, (n, k) each."""
    if palette.rigid:
        return np.zeros((count, 1), np.int64), np.ones((count, 1))
    joints, weights = [], []
    for number in range(4):
        if f"JOINTS_{number}" in primitive.attributes and f"WEIGHTS_{number}" in primitive.attributes:
            joints.append(read_accessor(gltf, primitive.attributes[f"JOINTS_{number}"], "VEC4"))
            weights.append(read_accessor(gltf, primitive.attributes[f"WEIGHTS_{number}"], "VEC4").astype(np.float64))
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


def _read_faces(gltf: GltfFile, primitive: Primitive, count: int, what: str) -> Array:
    order = np.arange(count) if primitive.indices is None else read_accessor(gltf, primitive.indices, "SCALAR")[:, 0]
    order = order.astype(np.int64)
    if len(order) and (order.min() < 0 or order.max() >= count):
        raise FileFormatError(gltf.path, f"{what} names vertex {order.max()} of {count}")
    if primitive.mode == _TRIANGLES:
        return order[: len(order) // 3 * 3].reshape(-1, 3)
    if primitive.mode == _STRIP:
        faces = np.stack([order[:-2], order[1:-1], order[2:]], axis=1)
        faces[1::2] = faces[1::2, ::-1]
        return faces
    return np.stack([np.full(max(len(order) - 2, 0), order[0]), order[1:-1], order[2:]], axis=1)
