"""glTF, VRM and VRM animations in: which nodes are a character's joints, their rest pose, and an animation of them."""

from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from fractions import Fraction
from os import PathLike

import numpy as np
import torch

from mapctl import rotations
from mapctl.errors import FileFormatError
from mapctl.formats.character import (
    CharacterSource,
    RestFrames,
    build_frames,
    build_part,
    chain_matrices,
    choose_name,
    complete_bind_pose,
    compose_matrices,
    note_animation,
    sample_times,
    stamp_file,
)
from mapctl.formats.gltf.document import (
    GltfFile,
    Json,
    read_accessor,
    read_file,
    read_neighbour,
    read_view,
    refuse_malformed,
)
from mapctl.formats.parts import (
    CharacterPath,
    MeshPart,
    decode_picture,
    decode_srgb,
    encode_srgb,
    make_unique,
    parse_character_path,
    sample_picture,
)
from mapctl.formats.text import check_extent
from mapctl.mesh.character_mesh import CharacterMesh, merge_meshes
from mapctl.motion import Motion
from mapctl.skeleton import CANONICAL, Skeleton

Array = np.ndarray
LICENCE = "licence"
"""Key of the asset's extras under which mapctl writes the licence of a motion."""
_MAX_JOINTS = 4096
_TRIANGLES, _STRIP, _FAN = 4, 5, 6
_WIDTHS = {"translation": "VEC3", "rotation": "VEC4", "scale": "VEC3"}
ANIMATION = "VRMC_vrm_animation"
"""Extension of a file that holds the animation of a humanoid alone."""
_EXTENSIONS = "VRMC_vrm", ANIMATION


@dataclass(frozen=True, eq=False)
class Armature:
    """A connected tree of nodes that are one character's joints."""

    name: str
    """Name by which it is chosen."""
    nodes: tuple[int, ...]
    """Its nodes, parents first; the first is the root."""
    parents: tuple[int, ...]
    """Index among `nodes` of each one's parent, -1 for the root."""
    skins: tuple[int, ...]
    """Skins that it carries."""
    ends: dict[int, int]
    """Node that is the End Site of a last joint, by that joint's index among `nodes`."""
    all_names: Sequence[str] = ()
    """Names of all armatures of the file."""


@dataclass(frozen=True, eq=False)
class Track:
    """Keys of one property of a node."""

    node: int
    path: str
    """translation, rotation or scale."""
    times: Array
    """(keys,) seconds, increasing."""
    values: Array
    """(keys, 3 or 4), or (3 keys, 3 or 4) with tangents for cubic splines."""
    interpolation: str


class NodeTree:
    """Parents of nodes; FileFormatError where a node has two, is not there, or is below itself."""

    def __init__(self, gltf: GltfFile):
        self.gltf, nodes = gltf, gltf.all("nodes")
        self.parent: dict[int, int] = {}
        for number, node in enumerate(nodes):
            children = node.get("children", ())
            self.check_nodes(children, f"nodes[{number}].children")
            for child in children:
                if child in self.parent:
                    raise FileFormatError(gltf.path, f"nodes[{child}] has two parents")
                self.parent[child] = number

    def check_nodes(self, nodes: Iterable[int], what: str) -> None:
        """Raise FileFormatError unless all of these nodes are there."""
        count = len(self.gltf.all("nodes"))
        for node in nodes:
            if not 0 <= node < count:
                raise FileFormatError(self.gltf.path, f"{what} names node {node}, there are {count}")

    def line(self, node: int) -> list[int]:
        """Return a node and all above it, up to the scene."""
        found = [node]
        while found[-1] in self.parent:
            found.append(self.parent[found[-1]])
            if len(found) > _MAX_JOINTS:
                raise FileFormatError(
                    self.gltf.path, f"nodes[{node}] is below itself, or below more than {_MAX_JOINTS} others"
                )
        return found

    def connect(self, nodes: Iterable[int]) -> list[int]:
        """Return these nodes, what lies between them, and their common root, parents first."""
        lines = [self.line(node)[::-1] for node in set(nodes)]
        common = lines[0]
        for line in lines[1:]:
            same = [a == b for a, b in zip(common, line, strict=False)]
            common = common[: same.index(False) if False in same else len(same)]
        if not common:
            raise FileFormatError(self.gltf.path, "joints of one skin have no common node above them")
        depth = len(common) - 1
        wanted = {node for line in lines for node in line[depth:]}
        return [node for node in self.walk(common[-1]) if node in wanted]

    def walk(self, root: int) -> Iterator[int]:
        """Go through a node and all below it, parents first, depth first."""
        waiting = [root]
        while waiting:
            node = waiting.pop()
            yield node
            waiting += reversed(self.gltf.get("nodes", node).get("children", ()))

    def outer_matrix(self, root: int) -> Array:
        """Return what takes the frame that a node is in to the scene, (4, 4)."""
        matrix = np.eye(4)
        for node in reversed(self.line(root)[1:]):
            matrix = matrix @ node_matrix(self.gltf.get("nodes", node))
        return matrix


@refuse_malformed
def load(path: str | PathLike[str]) -> Motion:
    """Read an animation of a character from a .glb, .gltf, .vrm or .vrma file; one frame of its rest pose where it has
    none.

    `path` may end as `#ARMATURE`, `#ARMATURE/ANIMATION` or `#/ANIMATION`; by default the file's first animation that
    moves the armature is read, and a file of several armatures is refused, naming them. Joint frames are aligned with
    the world in the rest pose. FileFormatError says what is wrong with the file.
    """
    chosen, gltf, armature = open_character(path)
    frames, skeleton = read_skeleton(gltf, armature)
    found = _find_animation(gltf, armature, chosen)
    if found is None:
        return frames.rest_motion(skeleton, _source(gltf, armature, frames, None))
    name, tracks = found
    source = replace(_source(gltf, armature, frames, name), animations=time_animations(gltf, armature.nodes))
    note_animation(chosen, source.animations, name)
    fps, local = sample_local_matrices(gltf, armature.nodes, tracks)
    worlds = chain_matrices(armature.parents, local, frames.outer)
    extras = gltf.tree["asset"].get("extras")
    licence = extras.get(LICENCE) if isinstance(extras, dict) else None
    motion = frames.to_motion(worlds, fps, skeleton, source)
    return replace(motion, licence=licence if isinstance(licence, str) else "")


@refuse_malformed
def load_rest(path: str | PathLike[str]) -> Motion:
    """Read one frame of a character's rest pose, as `load` reads its animation."""
    _, gltf, armature = open_character(path)
    frames, skeleton = read_skeleton(gltf, armature)
    return frames.rest_motion(skeleton, _source(gltf, armature, frames, None))


def open_character(path: str | PathLike[str]) -> tuple[CharacterPath, GltfFile, Armature]:
    """Read a file and choose its armature."""
    chosen = parse_character_path(path)
    gltf = read_file(chosen.file)
    armatures = find_armatures(gltf)
    names = [armature.name for armature in armatures]
    return chosen, gltf, armatures[choose_name(chosen.file, names, chosen.armature, "armature", several=False)]


def read_skeleton(gltf: GltfFile, armature: Armature) -> tuple[RestFrames, Skeleton]:
    """Read the rest frames, and the skeleton that is aligned with the world in them.

    The rest pose is the one in which the skins are bound where all of them say one and bones are as long as the nodes'
    (VRM files: always the nodes'); else the nodes'. FileFormatError for uneven scale.
    """
    names = make_unique([str(gltf.get("nodes", node).get("name") or f"node_{node}") for node in armature.nodes])
    local = np.stack([node_matrix(gltf.get("nodes", node)) for node in armature.nodes])
    outer = NodeTree(gltf).outer_matrix(armature.nodes[0])
    worlds = chain_matrices(armature.parents, local, outer)
    frames = build_frames(gltf.path, armature.name, names, armature.parents, worlds, outer)
    is_vrm = any(name in gltf.tree.get("extensions", {}) for name in ("VRM", *_EXTENSIONS))  # whatever its ending
    if not is_vrm and (bound := _bind_worlds(gltf, armature, worlds, outer)) is not None:
        frames = RestFrames.of(tuple(names), armature.parents, bound, outer)
    rests = frames.matrices()
    ends = {
        joint: (rests[joint] @ node_matrix(gltf.get("nodes", node)))[:3, 3] for joint, node in armature.ends.items()
    }
    skeleton = frames.skeleton(ends)
    if not float(skeleton.offsets.abs().max()) <= 1e6:
        raise FileFormatError(gltf.path, f"armature {armature.name!r} is larger than 1000 km")
    return frames, skeleton


def _find_animation(gltf: GltfFile, armature: Armature, chosen: CharacterPath):
    """Return name and tracks of the chosen animation, or of the first that moves the armature; None where none does."""
    names = name_animations(gltf)
    if chosen.animation is not None:
        number = choose_name(gltf.path, names, chosen.animation, "animation", several=True)
        tracks = read_tracks(gltf, number, armature.nodes)
        if not tracks:
            raise FileFormatError(gltf.path, f"animation {names[number]!r} does not move {armature.name!r}")
        return names[number], tracks
    read = ((name, read_tracks(gltf, number, armature.nodes)) for number, name in enumerate(names))
    return next((found for found in read if found[1]), None)


def _source(gltf: GltfFile, armature: Armature, frames: RestFrames, animation: str | None) -> CharacterSource:
    at = dict(zip(armature.nodes, frames.names, strict=True))
    bones = {bone: at[node] for bone, node in read_bones(gltf).items() if node in at}
    if "upperChest" in bones:  # it carries the arms, and is the canonical chest where a file has one
        bones["chest"] = bones["upperChest"]
    humanoid = {bone: name for bone, name in bones.items() if bone in CANONICAL.names}
    return CharacterSource(
        gltf.path.resolve(),
        armature.name,
        stamp_file(gltf.path),
        frames,
        armature.nodes,
        animation,
        humanoid,
        armature.all_names,
    )


def find_armatures(gltf: GltfFile) -> list[Armature]:
    """Find the armatures of a file; FileFormatError where nothing says which nodes are joints, or they are no tree."""
    skins, animated, tree = gltf.all("skins"), _animated_nodes(gltf), NodeTree(gltf)
    groups: list[tuple[set[int], list[int]]] = []
    if not skins:
        groups = [(joints, []) for joints in _find_bare_joints(gltf, tree, animated)]
    for number, skin in enumerate(skins):
        tree.check_nodes(skin["joints"], f"skins[{number}].joints")
        joints = set(tree.connect(skin["joints"]))
        near = [group for group in groups if group[0] & joints or _share_line(tree, group[0], joints)]
        groups = [group for group in groups if group not in near]
        groups.append((joints.union(*(g[0] for g in near)), sorted({number, *(s for g in near for s in g[1])})))
    by_skin = sorted(groups, key=lambda group: group[1])
    found = [_build_armature(gltf, tree, joints, skins, animated) for joints, skins in by_skin]
    names = make_unique([armature.name for armature in found])
    return [replace(armature, name=name, all_names=names) for name, armature in zip(names, found, strict=True)]


def read_inverse_binds(gltf: GltfFile, skin: int) -> Array | None:
    """Return the matrices (joints, 4, 4) from a skin's vertices to its joints' frames; None where it has none."""
    entry = gltf.get("skins", skin)
    if entry.get("inverseBindMatrices") is None:
        return None
    inverse = read_accessor(gltf, entry["inverseBindMatrices"], "MAT4").reshape(-1, 4, 4).transpose(0, 2, 1)
    count = len(entry["joints"])
    if len(inverse) < count:
        raise FileFormatError(gltf.path, f"skins[{skin}] has {count} joints and {len(inverse)} inverse bind matrices")
    return inverse[:count]


def node_matrix(node: Json) -> Array:
    """Return what takes a node's frame to its parent's, (4, 4)."""
    if node.get("matrix") is not None:
        return np.array(node["matrix"], np.float64).reshape(4, 4).T
    place, turn, scale = node_parts(node)
    length = np.linalg.norm(turn)
    turn = turn / length if length > 1e-9 else np.array([0.0, 0.0, 0.0, 1.0])
    return compose_matrices(place, turn, scale)


def node_parts(node: Json) -> tuple[Array, Array, Array]:
    """Return translation (3,), rotation xyzw (4,) and scale (3,) of a node without a matrix."""
    usual = {"translation": (0.0, 0.0, 0.0), "rotation": (0.0, 0.0, 0.0, 1.0), "scale": (1.0, 1.0, 1.0)}
    place, turn, scale = (np.array(node.get(key, value), np.float64) for key, value in usual.items())
    if (place.shape, turn.shape, scale.shape) != ((3,), (4,), (3,)):
        raise ValueError("a node's translation and scale have 3 numbers, its rotation 4")
    return place, turn, scale


def _share_line(tree: NodeTree, first: set[int], second: set[int]) -> bool:
    """Return whether one set of joints hangs below the other: a hat's skin below the head's joint."""
    tops = [min(nodes, key=lambda node: len(tree.line(node))) for nodes in (first, second)]
    return bool(set(tree.line(tops[0])) & second or set(tree.line(tops[1])) & first)


def _animated_nodes(gltf: GltfFile) -> set[int]:
    targets = [c["target"] for animation in gltf.all("animations") for c in animation.get("channels", ())]
    return {target["node"] for target in targets if target.get("node") is not None and target["path"] != "weights"}


def _find_bare_joints(gltf: GltfFile, tree: NodeTree, animated: set[int]) -> list[set[int]]:
    """Find the joints of the characters of a file without a skin: the humanoid's, else of each tree those that an
    animation moves, and those below them that carry others."""
    bones = set(read_bones(gltf).values())
    tree.check_nodes(bones, "the humanoid")
    if bones:
        return [bones]
    if not animated:
        what = "has no skin, no humanoid and no animation, so nothing in it says which nodes are a character's joints"
        raise FileFormatError(gltf.path, what)
    tree.check_nodes(animated, "an animation")
    tops: dict[int, list[int]] = {}
    for node in sorted(animated):
        tops.setdefault(tree.line(node)[-1], []).append(node)
    bodies = [moved for moved in tops.values() if len(moved) > 1] or list(tops.values())
    walks = [(set(moved), tree.walk(tree.connect(moved)[0])) for moved in bodies]
    return [{n for n in below if n in moved or gltf.get("nodes", n).get("children")} for moved, below in walks]


def _build_armature(gltf: GltfFile, tree: NodeTree, joints: set[int], skins: list[int], animated: set[int]) -> Armature:
    """Build the tree of a group's joints; its root is the topmost node above them that any animation moves."""
    nodes = gltf.all("nodes")
    bones = set(read_bones(gltf).values())
    own = tree.connect(joints)
    wanted = set(tree.connect([*own, *(bones & set(tree.walk(own[0])))]))
    moved = [node for node in tree.line(own[0])[1:] if node in animated]
    if moved:
        wanted |= {node for node in tree.line(own[0]) if moved[-1] in tree.line(node)}
    order = [node for node in tree.walk(moved[-1] if moved else own[0]) if node in wanted]
    if len(order) > _MAX_JOINTS:
        raise FileFormatError(gltf.path, f"an armature has {len(order)} joints, allowed are {_MAX_JOINTS}")
    place = {node: index for index, node in enumerate(order)}
    parents = tuple(-1 if node == order[0] else place[tree.parent[node]] for node in order)
    ends = {}
    for node in order:
        children = nodes[node].get("children", ())
        tips = [child for child in children if child not in place and nodes[child].get("mesh") is None]
        if len(tips) == 1 and not any(child in place for child in children):
            ends[place[node]] = tips[0]
    above = [nodes[k] for k in (tree.parent.get(order[0]), order[0]) if k is not None]  # exporters name it there
    named = [*(gltf.get("skins", skin) for skin in skins[:1]), *above]
    name = next((str(one["name"]) for one in named if one.get("name")), f"armature_{order[0]}")
    return Armature(name, tuple(order), parents, tuple(skins), ends)


def _bind_worlds(gltf: GltfFile, armature: Armature, worlds: Array, outer: Array) -> Array | None:
    """Return world matrices (joints, 4, 4) of the pose in which the skins are bound, as far as they agree with the
    nodes' bones; None where they do not, or are not said.

    Bind matrices are in the space of the vertices: that of the scene, or that of what is above the root.
    """
    place = {node: index for index, node in enumerate(armature.nodes)}
    bound: dict[int, Array] = {}
    for number in armature.skins:
        inverse = read_inverse_binds(gltf, number)
        if inverse is None:
            return None
        for node, matrix in zip(gltf.get("skins", number)["joints"], inverse, strict=True):
            bound.setdefault(place[node], np.linalg.inv(matrix))  # a ValueError where it is singular
    for space in (np.eye(4), outer):
        found = complete_bind_pose(armature.parents, {joint: space @ matrix for joint, matrix in bound.items()}, worlds)
        if found is not None:
            return found
    return None


def name_animations(gltf: GltfFile) -> list[str]:
    """Return the names of a file's animations, unique, in its order."""
    return make_unique([str(a.get("name") or f"animation_{k}") for k, a in enumerate(gltf.all("animations"))])


def time_animations(gltf: GltfFile, nodes: Sequence[int]) -> dict[str, float]:
    """Return the seconds that each animation lasts that moves these nodes, by name, without those whose key times
    cannot be read."""
    found = {}
    for name, animation in zip(name_animations(gltf), gltf.all("animations"), strict=True):
        with suppress(FileFormatError, IndexError, KeyError):
            targets = [(channel["sampler"], channel["target"]) for channel in animation.get("channels", ())]
            own = [k for k, target in targets if target.get("node") in nodes and target["path"] in _WIDTHS]
            inputs = {animation["samplers"][sampler]["input"] for sampler in own}
            ends = [read_accessor(gltf, times, "SCALAR")[[0, -1], 0].tolist() for times in inputs]
            if ends:
                found[name] = max(end for _, end in ends) - min(start for start, _ in ends)
    return found


def read_tracks(gltf: GltfFile, animation: int, nodes: Sequence[int]) -> list[Track]:
    """Read the tracks of these nodes in an animation; empty where it moves none of them."""
    found, wanted = [], set(nodes)
    entry = gltf.get("animations", animation)
    samplers = entry.get("samplers", [])
    for channel in entry.get("channels", ()):
        node, path = channel["target"].get("node"), channel["target"]["path"]
        if node not in wanted or path not in _WIDTHS:
            continue
        sampler = channel["sampler"]
        found.append(_read_track(gltf, node, path, samplers[sampler], f"animations[{animation}].samplers[{sampler}]"))
    return found


def sample_local_matrices(gltf: GltfFile, nodes: Sequence[int], tracks: Sequence[Track]) -> tuple[Fraction, Array]:
    """Return frames per second, and local matrices (frames, nodes, 4, 4) at its frames, from the first key to the last.

    FileFormatError where there would be too many.
    """
    keys = np.concatenate([track.times for track in tracks])
    span = float(keys.max() - keys.min())
    check_extent(gltf.path, int(span), 1)
    fps, times = sample_times(keys)
    check_extent(gltf.path, len(times), len(nodes))
    by_node: dict[int, list[Track]] = {}
    for track in tracks:
        by_node.setdefault(track.node, []).append(track)
    matrices = np.empty((len(times), len(nodes), 4, 4))
    for place, node in enumerate(nodes):
        own = gltf.get("nodes", node)
        matrices[:, place] = _sample_node(own, by_node[node], times) if node in by_node else node_matrix(own)
    return fps, matrices


def _read_track(gltf: GltfFile, node: int, path: str, sampler: Json, what: str) -> Track:
    interpolation = sampler.get("interpolation", "LINEAR")
    if interpolation not in ("LINEAR", "STEP", "CUBICSPLINE"):
        raise FileFormatError(gltf.path, f"{what}: no interpolation of glTF is {interpolation!r}")
    times = read_accessor(gltf, sampler["input"], "SCALAR")[:, 0].astype(np.float64)
    values = read_accessor(gltf, sampler["output"], _WIDTHS[path]).astype(np.float64)
    keys = len(times) * (3 if interpolation == "CUBICSPLINE" else 1)
    if len(values) != keys:
        raise FileFormatError(gltf.path, f"{what} has {len(times)} key times and {len(values)} values, expected {keys}")
    if (np.diff(times) < 0).any() or times[0] < 0 or times[-1] > 1e6:
        raise FileFormatError(gltf.path, f"{what}: key times must increase, from 0 to a million seconds")
    if path == "rotation" and interpolation != "CUBICSPLINE":
        lengths = np.linalg.norm(values, axis=1)
        if (abs(lengths - 1) > 0.1).any():
            raise FileFormatError(gltf.path, f"{what}: a rotation is no unit quaternion")
        values = values / lengths[:, None]
    return Track(node, path, times, values, interpolation)


def _sample_node(node: Json, tracks: Sequence[Track], times: Array) -> Array:
    usual = zip(("translation", "rotation", "scale"), node_parts(node), strict=True)
    parts = {path: np.tile(values, (len(times), 1)) for path, values in usual}
    for track in tracks:
        parts[track.path] = sample_track(track, times)
    lengths = np.linalg.norm(parts["rotation"], axis=1, keepdims=True)
    turns = np.where(lengths > 1e-9, parts["rotation"] / np.maximum(lengths, 1e-9), np.array([0.0, 0.0, 0.0, 1.0]))
    return compose_matrices(parts["translation"], turns, parts["scale"])


def sample_track(track: Track, times: Array) -> Array:
    """Return a track's values (times, 3 or 4) at times, seconds; before its first and after its last key it holds."""
    keys = track.times
    if len(keys) == 1:
        return np.tile(track.values[1 if track.interpolation == "CUBICSPLINE" else 0], (len(times), 1))
    low = np.clip(np.searchsorted(keys, times, side="right") - 1, 0, len(keys) - 2)
    gap = np.maximum(keys[low + 1] - keys[low], 1e-12)
    share = np.clip((times - keys[low]) / gap, 0.0, 1.0)
    if track.interpolation == "CUBICSPLINE":
        return _sample_spline(track.values.reshape(len(keys), 3, -1), low, gap, share)
    before, after = track.values[low], track.values[low + 1]
    if track.interpolation == "STEP":
        return np.where((share >= 1.0)[:, None], after, before)
    if track.path == "rotation":
        turns = rotations.slerp(*(torch.from_numpy(values) for values in (before, after, share)))
        return turns.numpy()
    return before + (after - before) * share[:, None]


def _sample_spline(keys: Array, low: Array, gap: Array, share: Array) -> Array:
    """Read cubic Hermite splines; `keys` (keys, 3, width) are in-tangent, value and out-tangent."""
    t, gap = share[:, None], gap[:, None]
    before, after = keys[low, 1], keys[low + 1, 1]
    leave, arrive = keys[low, 2] * gap, keys[low + 1, 0] * gap
    rise, bend = t * t * (3 - 2 * t), t * (1 - t)
    return before + (after - before) * rise + bend * ((1 - t) * leave - t * arrive)


def read_bones(gltf: GltfFile) -> dict[str, int]:
    """Return the node of each bone of the humanoid, by VRM's name; empty for files that are no VRM."""
    extensions = gltf.tree.get("extensions", {})
    for name in _EXTENSIONS:
        if name in extensions:
            bones = extensions[name].get("humanoid", {}).get("humanBones", {})
            return {bone: found["node"] for bone, found in bones.items()}
    bones = extensions.get("VRM", {}).get("humanoid", {}).get("humanBones", [])
    return {bone["bone"]: bone["node"] for bone in bones}


@refuse_malformed
def load_mesh(path: str | PathLike[str]) -> CharacterMesh:
    """Read the mesh of a character: what its skins carry, and what hangs on its joints rigidly. `path` chooses as in
    `load`. FileFormatError where the file has no triangles for the armature, or they are broken."""
    _, gltf, armature = open_character(path)
    frames, _ = read_skeleton(gltf, armature)
    tree, place = NodeTree(gltf), {node: joint for joint, node in enumerate(armature.nodes)}
    found: list[CharacterMesh] = []
    for number, node in enumerate(gltf.all("nodes")):
        mesh, skin = node.get("mesh"), node.get("skin")
        if mesh is None:
            continue
        if skin is not None and skin in armature.skins:
            joints = np.array([place[node] for node in gltf.get("skins", skin)["joints"]])
            inverse = read_inverse_binds(gltf, skin)
            matrices = np.tile(np.eye(4), (len(joints), 1, 1)) if inverse is None else inverse
        else:
            line = tree.line(number)
            above = next((above for above in line if above in place), None)
            if above is None or skin is not None:
                continue
            joints, matrix = np.array([place[above]]), np.eye(4)
            for below in reversed(line[: line.index(above)]):
                matrix = matrix @ node_matrix(gltf.get("nodes", below))
            matrices = matrix[None]
        for k, primitive in enumerate(gltf.get("meshes", mesh).get("primitives", ())):
            what = f"meshes[{mesh}].primitives[{k}]"
            if primitive.get("mode", 4) not in (_TRIANGLES, _STRIP, _FAN) or "POSITION" not in primitive["attributes"]:
                continue
            points = read_accessor(gltf, primitive["attributes"]["POSITION"], "VEC3").astype(np.float64)
            rows, shares = np.zeros((len(points), 1), np.int64), np.ones((len(points), 1))
            if skin is not None:
                rows, shares = _read_carriers(gltf, primitive, len(joints), len(points), what)
            faces = _read_faces(gltf, primitive, len(points), what)
            rgba = read_colours(gltf, primitive, len(points), what)
            found.append(build_part(gltf.path, MeshPart(points, faces, rgba, joints, matrices, rows, shares), frames))
    if not found:
        raise FileFormatError(gltf.path, f"armature {armature.name!r} carries no triangles")
    return merge_meshes(found)


def _read_carriers(gltf: GltfFile, primitive: Json, known: int, count: int, what: str) -> tuple[Array, Array]:
    """Return by vertex the indices among a skin's `known` joints and their shares, (n, k) each."""
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
    if own.min() < 0 or own.max() >= known:
        raise FileFormatError(gltf.path, f"{what} names joint {own.max()} of a skin of {known}")
    total = shares.sum(axis=1, keepdims=True)
    shares[total[:, 0] <= 0, 0] = 1.0
    return own, shares / np.where(total > 0, total, 1.0)


def _read_faces(gltf: GltfFile, primitive: Json, count: int, what: str) -> Array:
    indices = primitive.get("indices")
    order = np.arange(count) if indices is None else read_accessor(gltf, indices, "SCALAR")[:, 0].astype(np.int64)
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


def read_colours(gltf: GltfFile, primitive: Json, count: int, what: str) -> Array:
    """Read the colours of a primitive's `count` vertices, (n, 4): sRGB and opacity, 0 to 1.

    Without the package pillow, or of a kind that it does not know, a picture's place is taken by the material's plain
    colour.
    """
    material = {} if primitive.get("material") is None else gltf.get("materials", primitive["material"])
    look = material.get("pbrMetallicRoughness", {})
    linear = np.tile(np.array(look.get("baseColorFactor", (1.0, 1.0, 1.0, 1.0)), np.float64), (count, 1))
    if "COLOR_0" in primitive["attributes"]:
        own = read_accessor(gltf, primitive["attributes"]["COLOR_0"], "VEC3", "VEC4").astype(np.float64)
        if len(own) != count:
            raise FileFormatError(gltf.path, f"{what} has {count} vertices and {len(own)} colours")
        linear[:, : own.shape[1]] *= own
    texture = look.get("baseColorTexture")
    shown = None if texture is None else _read_shown(gltf, primitive, texture, count)
    if shown is not None:
        texels = sample_picture(shown[1], shown[0])
        linear *= np.column_stack([decode_srgb(texels[:, :3]), texels[:, 3]])
    opacity = linear[:, 3:] if material.get("alphaMode") == "BLEND" else np.ones((count, 1))
    return np.concatenate([encode_srgb(linear[:, :3]), opacity], axis=1).clip(0.0, 1.0)


def _read_shown(gltf: GltfFile, primitive: Json, info: Json, count: int) -> tuple[Array, Array] | None:
    """Return where the vertices are in the picture, and the picture; None where it cannot be read."""
    name, source = f"TEXCOORD_{info.get('texCoord', 0)}", gltf.get("textures", info["index"]).get("source")
    if name not in primitive["attributes"] or source is None:
        return None
    image = gltf.get("images", source)
    uri, view = image.get("uri"), image.get("bufferView")
    if uri is not None:
        picture = decode_picture(read_neighbour(gltf.path, uri))
    elif view is not None:
        picture = decode_picture(bytes(read_view(gltf, view)))
    else:
        return None
    where = read_accessor(gltf, primitive["attributes"][name], "VEC2").astype(np.float64)
    if len(where) != count:
        raise FileFormatError(gltf.path, f"{name} has {len(where)} rows for {count} vertices")
    return None if picture is None else (where, picture)
