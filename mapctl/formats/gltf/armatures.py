"""Which nodes of a glTF document are a character's joints: those of its skins, else of its humanoid, else those that an
animation moves; and what connects them."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from mapctl.errors import FileFormatError
from mapctl.formats.characters.bind_pose import complete_bind_pose
from mapctl.formats.characters.names import make_unique
from mapctl.formats.characters.rest_frames import RestFrames, UnevenScaleError, chain_matrices, compose_matrices
from mapctl.formats.gltf.accessors import read_accessor
from mapctl.formats.gltf.container import GltfFile
from mapctl.formats.gltf.schema import Node
from mapctl.formats.gltf.vrm import is_vrm, read_bones, select_canonical

Array = np.ndarray
_MAX_JOINTS = 4096


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


def find_armatures(gltf: GltfFile) -> list[Armature]:
    """Find the armatures of a file; FileFormatError where nothing says which nodes are joints, or they are no tree."""
    document, animated = gltf.document, _animated_nodes(gltf)
    tree = NodeTree(gltf)
    groups: list[tuple[set[int], list[int]]] = []
    if not document.skins:
        groups = [(joints, []) for joints in _find_bare_joints(gltf, tree, animated)]
    for number, skin in enumerate(document.skins):
        tree.check_nodes(skin.joints, f"skins[{number}].joints")
        if len(skin.joints) > _MAX_JOINTS:
            raise FileFormatError(
                gltf.path, f"skins[{number}] has {len(skin.joints)} joints, allowed are {_MAX_JOINTS}"
            )
        joints = set(tree.connect(skin.joints))
        near = [group for group in groups if group[0] & joints or _share_line(tree, group[0], joints)]
        groups = [group for group in groups if group not in near]
        groups.append((joints.union(*(g[0] for g in near)), sorted({number, *(s for g in near for s in g[1])})))
    groups.sort(key=lambda group: group[1])
    found = [_build_armature(gltf, tree, joints, skins, animated) for joints, skins in groups]
    names = make_unique([armature.name for armature in found])
    return [replace(armature, name=name, all_names=names) for name, armature in zip(names, found, strict=True)]


def read_rest_frames(gltf: GltfFile, armature: Armature) -> RestFrames:
    """Read the rest pose: the one in which the skins are bound where all of them say one and bones are as long as the
    nodes' (VRM files: always the nodes'); else the nodes'. FileFormatError for uneven scale."""
    tree = NodeTree(gltf)
    names = tuple(make_unique([gltf.document.nodes[node].name or f"node_{node}" for node in armature.nodes]))
    local = np.stack([node_matrix(gltf.document.nodes[node]) for node in armature.nodes])
    outer = tree.outer_matrix(armature.nodes[0])
    worlds = chain_matrices(armature.parents, local, outer)
    try:
        frames = RestFrames.of(names, armature.parents, worlds, outer)
    except UnevenScaleError as error:
        what = f"armature {armature.name!r}: {error.args[0]}; apply it and export again"
        raise FileFormatError(gltf.path, what) from None
    bound = None if is_vrm(gltf) else _bind_worlds(gltf, armature, worlds, outer)
    return frames if bound is None else RestFrames.of(names, armature.parents, bound, outer)


def read_humanoid_names(gltf: GltfFile, armature: Armature, names: tuple[str, ...]) -> dict[str, str]:
    """Return joint names by canonical name as a VRM file says them; empty for other files."""
    at = {node: name for node, name in zip(armature.nodes, names, strict=True)}
    return select_canonical({bone: at[node] for bone, node in read_bones(gltf).items() if node in at})


def node_matrix(node: Node) -> Array:
    """Return what takes a node's frame to its parent's, (4, 4)."""
    if node.matrix is not None:
        return np.array(node.matrix, np.float64).reshape(4, 4).T
    turn = np.array(node.rotation, np.float64)
    length = np.linalg.norm(turn)
    turn = turn / length if length > 1e-9 else np.array([0.0, 0.0, 0.0, 1.0])
    return compose_matrices(np.array(node.translation), turn, np.array(node.scale))


class NodeTree:
    """Parents of nodes; FileFormatError where a node has two, is not there, or is below itself."""

    def __init__(self, gltf: GltfFile):
        self.gltf, nodes = gltf, gltf.document.nodes
        self.parent: dict[int, int] = {}
        for number, node in enumerate(nodes):
            self.check_nodes(node.children, f"nodes[{number}].children")
            for child in node.children:
                if child in self.parent:
                    raise FileFormatError(
                        gltf.path, f"nodes[{child}] has two parents, {self.parent[child]} and {number}"
                    )
                self.parent[child] = number
        self._check_loops()

    def check_nodes(self, nodes: Iterable[int], what: str) -> None:
        """Raise FileFormatError unless all of these nodes are there."""
        count = len(self.gltf.document.nodes)
        for node in nodes:
            if node >= count:
                raise FileFormatError(self.gltf.path, f"{what} names node {node}, there are {count}")

    def _check_loops(self) -> None:
        reached: set[int] = set()
        for start in range(len(self.gltf.document.nodes)):
            trail, node = {start}, self.parent.get(start)
            while node is not None and node not in reached:
                if node in trail:
                    raise FileFormatError(self.gltf.path, f"nodes[{node}] is below itself")
                trail.add(node)
                node = self.parent.get(node)
            reached |= trail

    def line(self, node: int) -> list[int]:
        """Return a node and all above it, up to the scene."""
        found = [node]
        while found[-1] in self.parent:
            found.append(self.parent[found[-1]])
            if len(found) > _MAX_JOINTS:
                raise FileFormatError(self.gltf.path, f"nodes[{node}] lies deeper than {_MAX_JOINTS} others")
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
            waiting += reversed(self.gltf.document.nodes[node].children)

    def outer_matrix(self, root: int) -> Array:
        """Return what takes the frame that a node is in to the scene, (4, 4)."""
        matrix = np.eye(4)
        for node in reversed(self.line(root)[1:]):
            matrix = matrix @ node_matrix(self.gltf.document.nodes[node])
        return matrix


def _share_line(tree: NodeTree, first: set[int], second: set[int]) -> bool:
    """Return whether one set of joints hangs below the other: a hat's skin below the head's joint."""
    tops = [min(nodes, key=lambda node: len(tree.line(node))) for nodes in (first, second)]
    return bool(set(tree.line(tops[0])) & second or set(tree.line(tops[1])) & first)


def _animated_nodes(gltf: GltfFile) -> set[int]:
    channels = [channel.target for animation in gltf.document.animations for channel in animation.channels]
    return {target.node for target in channels if target.node is not None and target.path != "weights"}


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
    return [{n for n in below if n in moved or gltf.document.nodes[n].children} for moved, below in walks]


def _build_armature(gltf: GltfFile, tree: NodeTree, joints: set[int], skins: list[int], animated: set[int]) -> Armature:
    """Build the tree of a group's joints; its root is the topmost node above them that any animation moves."""
    document = gltf.document
    said = set(read_bones(gltf).values())
    tree.check_nodes(said, "the humanoid")
    own = tree.connect(joints)
    below = set(tree.walk(own[0]))
    wanted = set(tree.connect([*own, *(said & below)]))
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
        tips = [c for c in document.nodes[node].children if c not in place and document.nodes[c].mesh is None]
        if len(tips) == 1 and not any(child in place for child in document.nodes[node].children):
            ends[place[node]] = tips[0]
    return Armature(_armature_name(gltf, tree, order[0], skins), tuple(order), parents, tuple(skins), ends)


def _armature_name(gltf: GltfFile, tree: NodeTree, root: int, skins: list[int]) -> str:
    """Name an armature by its first skin, else by the node above its root, as exporters do, else by its root."""
    nodes = gltf.document.nodes
    above = tree.parent.get(root)
    skin = gltf.document.skins[skins[0]].name if skins else ""
    named = [skin, "" if above is None else nodes[above].name, nodes[root].name]
    return next((name for name in named if name), f"armature_{root}")


def _bind_worlds(gltf: GltfFile, armature: Armature, worlds: Array, outer: Array) -> Array | None:
    """Return world matrices (joints, 4, 4) of the pose in which the skins are bound, as far as they agree with the
    nodes' bones; None where they do not, or are not said.

    Bind matrices are in the space of the vertices: that of the scene, or that of what is above the root.
    """
    place = {node: index for index, node in enumerate(armature.nodes)}
    bound: dict[int, Array] = {}
    for number in armature.skins:
        skin = gltf.document.skins[number]
        if skin.inverseBindMatrices is None:
            return None
        inverse = read_accessor(gltf, skin.inverseBindMatrices, "MAT4").reshape(-1, 4, 4).transpose(0, 2, 1)
        if len(inverse) < len(skin.joints):
            raise FileFormatError(
                gltf.path, f"skins[{number}] has {len(skin.joints)} joints and {len(inverse)} inverse bind matrices"
            )
        for node, matrix in zip(skin.joints, inverse, strict=False):
            try:
                bound.setdefault(place[node], np.linalg.inv(matrix))
            except np.linalg.LinAlgError:
                raise FileFormatError(
                    gltf.path, f"skins[{number}]: the bind matrix of joint {node} is singular"
                ) from None
    for space in (np.eye(4), outer):
        found = complete_bind_pose(armature.parents, {joint: space @ matrix for joint, matrix in bound.items()}, worlds)
        if found is not None:
            return found
    return None
