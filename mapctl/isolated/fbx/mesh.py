"""Triangles of an FBX file that an armature carries."""

from pathlib import Path

import numpy as np
import ufbx

from mapctl.isolated.child import Refusal
from mapctl.isolated.fbx.armatures import Armature
from mapctl.isolated.fbx.scene import line_of, to_matrix
from mapctl.isolated.parts import MeshPart, strongest
from mapctl.isolated.pictures import decode_picture, decode_srgb, encode_srgb, sample_picture
from mapctl.isolated.polygons import mean_at_vertices, split_polygons

Array = np.ndarray
_MAX_CORNERS = 2**25
_GREY = (0.8, 0.8, 0.8, 1.0)


def read_parts(scene: ufbx.Scene, armature: Armature, folder: Path) -> list[MeshPart]:
    """Read what the armature's skins carry, and what hangs on its joints rigidly; pictures lie in `folder` or below."""
    place = {node.typed_id: joint for joint, node in enumerate(armature.nodes)}
    found = []
    for mesh in scene.meshes:
        if mesh.num_indices > _MAX_CORNERS:
            raise Refusal(f"mesh {mesh.name!r} has {mesh.num_indices} corners, allowed are {_MAX_CORNERS}")
        for node in mesh.instances:
            carriers = _read_carriers(mesh, node, place, armature)
            if carriers is not None and mesh.num_triangles:
                found.append(_read_part(mesh, node, carriers, folder))
    return found


def _read_carriers(
    mesh: ufbx.Mesh, node: ufbx.Node, place: dict[int, int], armature: Armature
) -> tuple[Array, Array, Array, Array] | None:
    """Return joints (m,) and matrices (m, 4, 4) from the mesh to their frames, and by vertex indices among them (n, k)
    and their shares; None where the armature does not carry the mesh."""
    count = mesh.num_vertices
    if len(mesh.skin_deformers):
        skin = mesh.skin_deformers[0]
        own = [place.get(c.bone_node.typed_id) if c.bone_node is not None else None for c in skin.clusters]
        if all(joint is None for joint in own):
            return None
        to_root = np.linalg.pinv(to_matrix(armature.nodes[0].node_to_world)) @ to_matrix(node.geometry_to_world)
        matrices = [to_root, *(to_matrix(cluster.geometry_to_bone) for cluster in skin.clusters)]
        rows, shares = _read_weights(skin, count)
        return np.array([0, *(joint or 0 for joint in own)]), np.stack(matrices), rows, shares
    above = next((other for other in line_of(node) if other.typed_id in place), None)
    if above is None:
        return None
    matrix = np.linalg.pinv(to_matrix(above.node_to_world)) @ to_matrix(node.geometry_to_world)
    return np.array([place[above.typed_id]]), matrix[None], np.zeros((count, 1), np.int64), np.ones((count, 1))


def _read_weights(skin: ufbx.SkinDeformer, count: int) -> tuple[Array, Array]:
    """Return by vertex the clusters that carry it, counted from 1, and their shares; 0 is the root's for the others."""
    vertices, clusters, weights = [], [], []
    for number, cluster in enumerate(skin.clusters):
        vertices.append(np.array(cluster.vertices, np.int64).reshape(-1))
        weights.append(np.array(cluster.weights, np.float64).reshape(-1))
        clusters.append(np.full(len(vertices[-1]), number + 1))
    if not vertices:
        return np.zeros((count, 1), np.int64), np.ones((count, 1))
    return strongest(np.concatenate(vertices), np.concatenate(clusters), np.concatenate(weights), count)


def _read_part(mesh: ufbx.Mesh, node: ufbx.Node, carriers: tuple[Array, Array, Array, Array], folder: Path) -> MeshPart:
    faces = np.array([(face.index_begin, face.num_indices) for face in mesh.faces], np.int64).reshape(-1, 2)
    corner_vertex = np.array(mesh.vertex_indices, np.int64)
    corners, polygon = split_polygons(faces[:, 1])
    corners = corners + (faces[:, 0] - (np.cumsum(faces[:, 1]) - faces[:, 1]))[polygon][:, None]
    points = np.array(mesh.vertices, np.float64).reshape(-1, 3)
    rgba = mean_at_vertices(_corner_colours(mesh, node, faces, folder), corner_vertex, len(points))
    joints, matrices, rows, shares = carriers
    return MeshPart(points, corner_vertex[corners], rgba, joints, matrices, rows, shares)


def _corner_colours(mesh: ufbx.Mesh, node: ufbx.Node, faces: Array, folder: Path) -> Array:
    """Return sRGB and opacity at every corner, (corners, 4): of the material, its picture and the vertices' own."""
    count = mesh.num_indices
    rgba = np.tile(np.array(_GREY), (count, 1))
    material = np.zeros(count, np.int64)
    order = (
        np.repeat(faces[:, 0], faces[:, 1])
        + np.arange(faces[:, 1].sum())
        - np.repeat(np.cumsum(faces[:, 1]) - faces[:, 1], faces[:, 1])
    )
    if len(mesh.face_material) == len(faces):
        material[order] = np.repeat(np.array(mesh.face_material, np.int64), faces[:, 1])
    uv = _corner_values(mesh.vertex_uv, count, 2)
    for number, look in enumerate(node.materials or mesh.materials):
        here = material == number
        rgba[here] = _material_colours(look, None if uv is None else uv[here], int(here.sum()), folder)
    own = _corner_values(mesh.vertex_color, count, 4)
    if own is not None:
        rgba = np.column_stack([encode_srgb(decode_srgb(rgba[:, :3]) * own[:, :3].clip(0, 1)), rgba[:, 3]])
    rgba[:, 3] = 1.0
    return rgba.clip(0.0, 1.0)


def _corner_values(table: ufbx.VertexVec2 | ufbx.VertexVec4, count: int, width: int) -> Array | None:
    if not table.exists or not len(table.values) or len(table.indices) != count:
        return None
    values = np.array(table.values, np.float64).reshape(-1, width)
    return values[np.array(table.indices, np.int64).clip(0, len(values) - 1)]


def _material_colours(look: ufbx.Material, uv: Array | None, count: int, folder: Path) -> Array:
    maps = look.fbx.diffuse_color if look.fbx.diffuse_color.has_value else look.pbr.base_color
    factor = look.fbx.diffuse_factor.value_vec4.x if look.fbx.diffuse_factor.has_value else 1.0
    linear = np.array(maps.value_vec4[:3]) * factor if maps.has_value else np.array(_GREY[:3])
    picture = None if uv is None or maps.texture is None else _read_picture(maps.texture, folder)
    if picture is None or uv is None:
        return np.tile(np.append(encode_srgb(linear), 1.0), (count, 1))
    return sample_picture(picture, np.column_stack([uv[:, 0], 1.0 - uv[:, 1]]))


def _read_picture(texture: ufbx.Texture, folder: Path) -> Array | None:
    """Read the picture within the file, or one in its folder or below; None where it is neither."""
    if texture.content:
        return decode_picture(texture.content)
    for name in (texture.relative_filename, Path(texture.absolute_filename.replace("\\", "/")).name):
        target = (folder / name.replace("\\", "/").replace("\0", "?")).resolve()
        if name and target.is_relative_to(folder) and target.is_file():
            return decode_picture(target.read_bytes())
    return None
