"""FBX in, by the package ufbx: characters and captures, as rigs and as clips.

`find_character` and all below it run in `mapctl.formats.sandbox`, without torch.
"""

from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import ufbx

from mapctl.formats import parts, sandbox
from mapctl.formats.sandbox import Refusal
from mapctl.formats.units import USUAL_FPS, frame_rate_of

Array = np.ndarray
NEWEST, OLDEST = 7799, 3000
"""Versions of FBX (7400 is 7.4) that are read."""
_MAX_ELEMENTS = 2**20
_BODY_JOINTS = 8
"""Two trees of at least as many joints, below one node and without a common skin, are two characters."""
_MODE_119_88 = 18  # of the FBX SDK, which ufbx 0.0.5 reads as 24 frames a second
_EARLY_SHARE = 0.02  # of a frame by which a take may end before it
_MOVED = ("Lcl Translation", "Lcl Rotation", "Lcl Scaling")
_kept: list[object] = []


def read_character(path: Path, **choice: str | None) -> parts.FoundCharacter:
    """Read a character in a sandbox: see `find_character`."""
    return sandbox.call(find_character, path, **choice)


def find_character(path: str, *, armature: str | None, animation: str | None, wanted: str) -> parts.FoundCharacter:
    """Read an armature, and `wanted` besides: `rest` nothing, `motion` its animation, `mesh` its triangles. Refusal
    gives the reason.

    The rest pose is the one in which skins are bound where bones are as long as the nodes', else the nodes'.
    """
    scene, fault = open_scene(path, with_mesh=wanted == "mesh")
    nodes = each(scene.nodes)
    tree = parts.NodeTree({node.typed_id: [child.typed_id for child in each(node.children)] for node in nodes})
    listed, own = parts.choose_armature(path, find_armatures(scene, nodes, tree), armature)
    joints, above = ([nodes[k] for k in numbers] for numbers in (own.nodes, tree.line(own.nodes[0])[1:]))
    names = parts.make_unique([node.name or f"node_{node.typed_id}" for node in joints])
    worlds = np.stack([to_matrix(node.node_to_world) for node in joints])
    bound = _read_bind_poses(scene, own)
    parts.check_size(worlds, *(matrix for pose in bound for matrix in pose.values()))
    complete = parts.complete_bind_pose(own.parents, bound, worlds)
    found = parts.FoundCharacter(
        armature=own.name,
        armatures=listed,
        names=names,
        nodes=names,
        parents=own.parents,
        metres_per_unit=scene.settings.original_unit_meters,
        worlds=worlds if complete is None else complete,
        outer=to_matrix(above[0].node_to_world) if above else np.eye(4),
        ends={joint: to_matrix(nodes[end].node_to_parent)[:, 3:] for joint, end in own.ends.items()},
        fault=fault,
    )
    if wanted == "motion":
        takes = _name_takes(scene, {node.element_id for node in [*joints, *above]})
        found.animations = {name: end - begin for name, (_, begin, end) in takes.items()}
        found.animation = next(iter(takes), None) if animation is None else animation
        if animation is not None and animation not in takes:
            every = _list_takes(scene)
            parts.find_name("", list(every), animation, "animation")
            raise Refusal(f"animation {animation!r} does not move {own.name!r}")
        if found.animation is not None:
            found.motion = _sample(scene, found.animation, *takes[found.animation], joints, above, own.parents)
    if wanted == "mesh":
        index_of = {node: joint for joint, node in enumerate(own.nodes)}
        found.parts = _read_parts(scene, index_of, tree, joints, Path(path).resolve().parent)
    return found


def open_scene(path: str, *, with_mesh: bool) -> tuple[ufbx.Scene, str]:
    """Read a file; also return what is wrong with its meshes, empty where nothing is.

    Refusal where it is no FBX, broken (but in its meshes, unless these are requested), encrypted or of another version.
    """
    fault = ""
    try:
        scene = _load(path, ignore_embedded=not with_mesh)
    except Refusal:
        if with_mesh:
            raise
        scene, fault = _load(path, ignore_embedded=True, ignore_geometry=True), "its meshes are broken"
    version = scene.metadata.version
    if not OLDEST <= version <= NEWEST:
        raise Refusal(f"is FBX {version / 1000:g}, read are {OLDEST / 1000:g} to 7.7")
    count = sum(found.count for found in each(scene.metadata.warnings) if found.type == ufbx.WarningType.INDEX_CLAMPED)
    if count:
        fault = f"{count} of its meshes' indices point at nothing, so they may look wrong"
    if len(scene.elements) > _MAX_ELEMENTS:
        raise Refusal(f"has {len(scene.elements)} elements, allowed are {_MAX_ELEMENTS}")
    return scene, fault


def _load(path: str, *, ignore_embedded: bool, ignore_geometry: bool = False) -> ufbx.Scene:
    try:
        return ufbx.load_file(
            path,
            file_format=ufbx.FileFormat.FBX,
            target_axes=ufbx.axes_right_handed_y_up,
            target_unit_meters=1.0,
            space_conversion=ufbx.SpaceConversion.ADJUST_TRANSFORMS,
            inherit_mode_handling=ufbx.InheritModeHandling.COMPENSATE,
            index_error_handling=ufbx.IndexErrorHandling.CLAMP,
            load_external_files=False,
            ignore_embedded=ignore_embedded,
            ignore_geometry=ignore_geometry,
            generate_missing_normals=False,
            node_depth_limit=1024,
        )
    except ufbx.UnsupportedVersionError:
        raise Refusal("is FBX of a version that is not read; export it as 7.4 or 7.5") from None
    except ufbx.UnrecognizedFileFormatError:
        raise Refusal("is no FBX file") from None
    except ufbx.OutOfMemoryError:
        raise MemoryError from None
    except ufbx.UfbxError as error:
        raise Refusal(f"is no sound FBX file: {str(error).strip() or type(error).__name__}") from None


def each(elements: Any) -> list[Any]:
    """Return a scene's list as Python's, whose items then live as long as the process: ufbx 0.0.5 hands out what it has
    in lists without counting the reference, so that it would be freed while it is in use."""
    found = list(elements)
    _kept.extend(found)
    return found


def to_matrix(columns: ufbx.Matrix) -> Array:
    """Return a (4, 4) matrix of ufbx's four columns."""
    matrix = np.eye(4)
    matrix[:3] = np.array(columns).T
    return matrix


def find_armatures(scene: ufbx.Scene, nodes: list[ufbx.Node], tree: parts.NodeTree) -> list[parts.Armature]:
    """Find the armatures of a file, in its order. Refusal where it has none."""
    bones = _find_bones(scene, nodes, tree)
    if not bones:
        raise Refusal("has no limb nodes and no skin, so nothing in it marks nodes as a character's joints")
    return [_build(nodes, tree, tops, bones) for tops in _group(scene, tree, bones)]


def _read_bind_poses(scene: ufbx.Scene, armature: parts.Armature) -> list[dict[int, Array]]:
    """Return world matrices (4, 4) by joint of the bind poses of the file: by its skins, and by its bind poses."""
    index_of = {node: joint for joint, node in enumerate(armature.nodes)}
    skins: dict[int, Array] = {}
    for cluster in each(scene.skin_clusters):
        if cluster.bone_node is not None and cluster.bone_node.typed_id in index_of:
            skins.setdefault(index_of[cluster.bone_node.typed_id], to_matrix(cluster.bind_to_world))
    poses: dict[int, Array] = {}
    for pose in each(scene.poses):
        for bone in each(pose.bone_poses) if pose.is_bind_pose else ():
            if bone.bone_node.typed_id in index_of:
                poses.setdefault(index_of[bone.bone_node.typed_id], to_matrix(bone.bone_to_world))
    return [bound for bound in ({**poses, **skins}, poses) if bound]


def _find_bones(scene: ufbx.Scene, nodes: list[ufbx.Node], tree: parts.NodeTree) -> set[int]:
    """Return limb nodes and nodes of skins, with what lies between them."""
    found = {node.typed_id for node in nodes if node.bone is not None}
    carriers = [cluster.bone_node for cluster in each(scene.skin_clusters)]
    found |= {node.typed_id for node in carriers if node is not None and not node.is_root}
    for node in list(found):
        line = tree.line(node)
        found.update(line[: max(k for k, other in enumerate(line) if other in found)])
    return found


def _group(scene: ufbx.Scene, tree: parts.NodeTree, bones: set[int]) -> list[list[int]]:
    """Return the topmost joints by armature: those that share a skin, or hang on one node and are no two bodies."""
    root = scene.root_node.typed_id
    tops = [node for node in tree.walk(root) if node in bones and tree.parent[node] not in bones]
    top_of = {below: k for k, top in enumerate(tops) for below in tree.walk(top)}
    group = list(range(len(tops)))

    def join(first: int, second: int) -> None:
        old, new = group[second], group[first]
        group[:] = [new if one == old else one for one in group]

    for skin in each(scene.skin_deformers):
        members = [c.bone_node.typed_id for c in each(skin.clusters) if c.bone_node is not None]
        used = sorted({top_of[number] for number in members if number in top_of})
        for other in used[1:]:
            join(used[0], other)
    sizes = [sum(below in bones for below in tree.walk(top)) for top in tops]
    for first in range(len(tops)):
        for second in range(first + 1, len(tops)):
            same = tree.parent[tops[first]] == tree.parent[tops[second]] != root
            if same and min(sizes[first], sizes[second]) < _BODY_JOINTS:
                join(first, second)
    return [[top for top, own in zip(tops, group, strict=True) if own == one] for one in dict.fromkeys(group)]


def _build(nodes: list[ufbx.Node], tree: parts.NodeTree, tops: list[int], bones: set[int]) -> parts.Armature:
    between = tree.connect(tops)
    root, wanted = between[0], bones.union(between)

    def is_end(node: int) -> bool:
        """Return whether a node is the tip that exporters add to a last limb: NAME_end, alone below it."""
        alone = node != root and not tree.children[node] and len(tree.children[tree.parent[node]]) == 1
        return alone and nodes[node].name.lower().endswith("_end") and not nodes[tree.parent[node]].is_root

    joints = [node for node in tree.walk(root) if node in wanted]
    ends = {tree.parent[node]: node for node in joints if is_end(node)}
    joints = [node for node in joints if node not in ends.values()]
    if len(joints) > parts.MAX_JOINTS:
        raise Refusal(f"has an armature of {len(joints)} joints, allowed are {parts.MAX_JOINTS}")
    index_of = {node: index for index, node in enumerate(joints)}
    parents = tuple(-1 if node == root else index_of[tree.parent[node]] for node in joints)
    holder = nodes[tree.parent.get(root, root)]
    name = ("" if holder.is_root else holder.name) or nodes[root].name or "armature"
    return parts.Armature(name, joints, parents, {index_of[above]: end for above, end in ends.items()})


def _list_takes(scene: ufbx.Scene) -> dict[str, ufbx.AnimStack]:
    stacks = each(scene.anim_stacks)
    return dict(
        zip(parts.make_unique([stack.name or f"take_{k}" for k, stack in enumerate(stacks)]), stacks, strict=True)
    )


def _name_takes(scene: ufbx.Scene, own: set[int]) -> dict[str, tuple[ufbx.AnimStack, float, float]]:
    """Return the animations that move some of these elements, with their first and last second, by name."""
    takes = _list_takes(scene).items()
    return {name: (stack, *_find_range(stack, own)) for name, stack in takes if _moved_nodes(stack) & own}


def _moved_nodes(stack: ufbx.AnimStack) -> set[int]:
    """Return the elements whose transforms the animation moves."""
    return {
        prop.element.element_id
        for layer in each(stack.layers)
        for prop in each(layer.anim_props)
        if prop.prop_name in _MOVED or "Pivot" in prop.prop_name or "Offset" in prop.prop_name
    }


def _sample(
    scene: ufbx.Scene,
    name: str,
    stack: ufbx.AnimStack,
    begin: float,
    end: float,
    joints: list[ufbx.Node],
    above: list[ufbx.Node],
    parents: tuple[int, ...],
) -> tuple[Fraction, Array]:
    """Return frames per second, and world matrices (frames, joints, 4, 4); `above` are the nodes above the root."""
    rate = scene.settings.frames_per_second
    if ufbx.find_int(scene.settings.props, "TimeMode", 0) == _MODE_119_88:
        rate = 120 / 1.001
    rate = rate if np.isfinite(rate) and 0.01 <= rate <= 1e5 else float(USUAL_FPS)
    if abs(1.001 * rate - round(1.001 * rate)) < 1e-3:  # 29.97, which is rounded
        rate = round(1.001 * rate) / 1.001
    if not (np.isfinite(begin) and np.isfinite(end)) or end < begin:
        raise Refusal(f"animation {name!r} lasts from {begin:g} to {end:g} s")
    count = np.floor((end - begin) * rate + _EARLY_SHARE) + 1
    parts.check_poses(count, len(joints) + len(above))
    times = begin + np.arange(int(count)) / rate
    moved = _moved_nodes(stack)
    outer = np.eye(4)
    for node in reversed(above):
        outer = outer @ _sample_node(stack.anim, node, times, moved)
    local = np.stack([_sample_node(stack.anim, node, times, moved) for node in joints], axis=1)
    return frame_rate_of(rate), parts.chain_matrices(parents, local, outer)


def _find_range(stack: ufbx.AnimStack, own: set[int]) -> tuple[float, float]:
    """Return the first and last second of the animation, else those of the keys of these elements."""
    if stack.time_end > stack.time_begin:
        return stack.time_begin, stack.time_end
    curves = [
        curve
        for layer in each(stack.layers)
        for prop in each(layer.anim_props)
        if prop.element.element_id in own
        for curve in each(prop.anim_value.curves)
        if curve is not None and len(curve.keyframes)
    ]
    times = [time for curve in curves for time in (curve.min_time, curve.max_time)]
    return min(times, default=0.0), max(times, default=0.0)


def _sample_node(anim: ufbx.Anim, node: ufbx.Node, times: Array, moved: set[int]) -> Array:
    """Return what takes the node's frame to its parent's, (times, 4, 4)."""
    if node.is_root:
        found = [node.local_transform]
    else:
        shown = times if node.element_id in moved else times[:1]
        found = [ufbx.evaluate_transform(anim, node, time) for time in shown.tolist()]
    table = parts.compose_transforms(np.array([(*one.translation, *one.rotation, *one.scale) for one in found]))
    return np.broadcast_to(table, (len(times), 4, 4))


def _read_parts(
    scene: ufbx.Scene, index_of: dict[int, int], tree: parts.NodeTree, joints: list[ufbx.Node], folder: Path
) -> list[parts.MeshPart]:
    """Read what the armature's skins carry, and what hangs on its joints rigidly; pictures lie in `folder` or below."""
    found = []
    for mesh in each(scene.meshes):
        if mesh.num_indices > parts.MAX_CORNERS:
            raise Refusal(f"mesh {mesh.name!r} has {mesh.num_indices} corners, allowed are {parts.MAX_CORNERS}")
        for node in each(mesh.instances):
            carriers = _read_carriers(mesh, node, index_of, tree, joints)
            if carriers is not None and mesh.num_triangles:
                found.append(_read_part(mesh, node, carriers, folder))
    return found


def _read_carriers(
    mesh: ufbx.Mesh, node: ufbx.Node, index_of: dict[int, int], tree: parts.NodeTree, joints: list[ufbx.Node]
) -> tuple[Array, Array, Array, Array] | None:
    """Return joints (m,) and matrices (m, 4, 4) from the mesh to their frames, and by vertex indices among them (n, k)
    and their shares; None where the armature does not carry the mesh."""
    count = mesh.num_vertices
    if len(mesh.skin_deformers):
        skin = each(mesh.skin_deformers)[0]
        own = [index_of.get(c.bone_node.typed_id) if c.bone_node is not None else None for c in each(skin.clusters)]
        if all(joint is None for joint in own):
            return None
        to_root = np.linalg.pinv(to_matrix(joints[0].node_to_world)) @ to_matrix(node.geometry_to_world)
        matrices = [to_root, *(to_matrix(cluster.geometry_to_bone) for cluster in each(skin.clusters))]
        rows, shares = _read_weights(skin, count)
        return np.array([0, *(joint or 0 for joint in own)]), np.stack(matrices), rows, shares
    joint = next((index_of[other] for other in tree.line(node.typed_id)[:-1] if other in index_of), None)
    if joint is None:
        return None
    matrix = np.linalg.pinv(to_matrix(joints[joint].node_to_world)) @ to_matrix(node.geometry_to_world)
    return np.array([joint]), matrix[None], np.zeros((count, 1), np.int64), np.ones((count, 1))


def _read_weights(skin: ufbx.SkinDeformer, count: int) -> tuple[Array, Array]:
    """Return by vertex the clusters that carry it, counted from 1, and their shares; 0 is the root's for the others."""
    vertices, clusters, weights = [], [], []
    for number, cluster in enumerate(each(skin.clusters)):
        vertices.append(np.array(cluster.vertices, np.int64).reshape(-1))
        weights.append(np.array(cluster.weights, np.float64).reshape(-1))
        clusters.append(np.full(len(vertices[-1]), number + 1))
    if not vertices:
        return np.zeros((count, 1), np.int64), np.ones((count, 1))
    return parts.strongest(np.concatenate(vertices), np.concatenate(clusters), np.concatenate(weights), count)


def _read_part(
    mesh: ufbx.Mesh, node: ufbx.Node, carriers: tuple[Array, Array, Array, Array], folder: Path
) -> parts.MeshPart:
    faces = np.array([(face.index_begin, face.num_indices) for face in mesh.faces], np.int64).reshape(-1, 2)
    begin, counts = faces.T
    shift = begin - (np.cumsum(counts) - counts)  # from corners counted face by face to the mesh's own
    corners, polygon = parts.split_polygons(counts)
    corners = corners + shift[polygon][:, None]
    order = np.arange(counts.sum()) + np.repeat(shift, counts)
    material = np.zeros(mesh.num_indices, np.int64)
    if len(mesh.face_material) == len(faces):
        material[order] = np.repeat(np.array(mesh.face_material, np.int64), counts)
    corner_vertex = np.array(mesh.vertex_indices, np.int64)
    points = np.array(mesh.vertices, np.float64).reshape(-1, 3)
    rgba = parts.mean_at_vertices(_corner_colours(mesh, node, material, folder), corner_vertex, len(points))
    return parts.MeshPart(points, corner_vertex[corners], rgba, *carriers)


def _corner_colours(mesh: ufbx.Mesh, node: ufbx.Node, material: Array, folder: Path) -> Array:
    """Return sRGB and opacity at every corner, (corners, 4): of its `material` (corners,), the material's picture and
    the vertices' own."""
    count = mesh.num_indices
    rgba = np.tile(np.array(parts.GREY), (count, 1))
    uv = _corner_values(mesh.vertex_uv, count, 2)
    for number, look in enumerate(each(node.materials) or each(mesh.materials)):
        here = material == number
        rgba[here] = _material_colours(look, None if uv is None else uv[here], int(here.sum()), folder)
    own = _corner_values(mesh.vertex_color, count, 4)
    if own is not None:
        rgba = np.column_stack([parts.encode_srgb(parts.decode_srgb(rgba[:, :3]) * own[:, :3].clip(0, 1)), rgba[:, 3]])
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
    linear = np.array(maps.value_vec4[:3]) * factor if maps.has_value else np.array(parts.GREY[:3])
    picture = None if uv is None or maps.texture is None else _read_picture(maps.texture, folder)
    if picture is None or uv is None:
        return np.tile(np.append(parts.encode_srgb(linear), 1.0), (count, 1))
    return parts.sample_picture(picture, np.column_stack([uv[:, 0], 1.0 - uv[:, 1]]))


def _read_picture(texture: ufbx.Texture, folder: Path) -> Array | None:
    """Read the picture within the file, or one in its folder or below; None where it is neither."""
    if texture.content:
        return parts.decode_picture(texture.content)
    for name in (texture.relative_filename, Path(texture.absolute_filename.replace("\\", "/")).name):
        target = (folder / name.replace("\\", "/").replace("\0", "?")).resolve()
        if name and target.is_relative_to(folder) and target.is_file():
            return parts.decode_picture(target.read_bytes())
    return None
