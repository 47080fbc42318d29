"""Which nodes of an FBX file are a character's joints: its limb nodes and those that its skins are bound to."""

from dataclasses import dataclass

import numpy as np
import ufbx

from mapctl.isolated.child import Refusal
from mapctl.isolated.fbx.scene import above, line_of, to_matrix, walk
from mapctl.isolated.naming import make_unique

Array = np.ndarray
MAX_JOINTS = 4096
"""Most joints of an armature."""
_BODY_JOINTS = 8
"""Two trees of at least as many joints, below one node and without a common skin, are two characters."""


@dataclass(frozen=True, eq=False)
class Armature:
    """The tree of one character's joints."""

    name: str
    """Name by which it is chosen: of the node above its root, else of the root."""
    nodes: list[ufbx.Node]
    """Joints, parents first; the first is the root."""
    parents: list[int]
    """Index of each one's parent, -1 for the root."""
    ends: dict[int, ufbx.Node]
    """Node that is the End Site of a last joint, by that joint's index."""

    @property
    def names(self) -> list[str]:
        """Names of the joints, unique."""
        return make_unique([node.name or f"node_{node.typed_id}" for node in self.nodes])


def find_armatures(scene: ufbx.Scene) -> list[Armature]:
    """Find the armatures of a file, in its order. Refusal where it has none."""
    bones = _find_bones(scene)
    if not bones:
        raise Refusal("has no limb nodes and no skin, so nothing in it says which nodes are a character's joints")
    groups = _group(scene, bones)
    found = [_build(scene, group, bones) for group in groups]
    names = make_unique([armature.name for armature in found])
    return [Armature(name, a.nodes, a.parents, a.ends) for name, a in zip(names, found, strict=True)]


def read_bind_poses(scene: ufbx.Scene, armature: Armature) -> list[dict[int, Array]]:
    """Return world matrices (4, 4) by joint of the poses that the file says skins are bound in: by its skins, and by
    its bind poses."""
    place = {node.typed_id: joint for joint, node in enumerate(armature.nodes)}
    skins: dict[int, Array] = {}
    for cluster in scene.skin_clusters:
        if cluster.bone_node is not None and cluster.bone_node.typed_id in place:
            skins.setdefault(place[cluster.bone_node.typed_id], to_matrix(cluster.bind_to_world))
    poses: dict[int, Array] = {}
    for pose in scene.poses:
        for bone in pose.bone_poses if pose.is_bind_pose else ():
            if bone.bone_node.typed_id in place:
                poses.setdefault(place[bone.bone_node.typed_id], to_matrix(bone.bone_to_world))
    return [bound for bound in ({**poses, **skins}, poses) if bound]


def _find_bones(scene: ufbx.Scene) -> dict[int, ufbx.Node]:
    """Return limb nodes and nodes of skins, with what lies between them, by number."""
    found = {node.typed_id: node for node in scene.nodes if node.bone is not None}
    for cluster in scene.skin_clusters:
        if cluster.bone_node is not None and not cluster.bone_node.is_root:
            found[cluster.bone_node.typed_id] = cluster.bone_node
    for node in list(found.values()):
        line = line_of(node)
        last = max((k for k, other in enumerate(line) if other.typed_id in found), default=0)
        found.update({other.typed_id: other for other in line[:last]})
    return found


def _group(scene: ufbx.Scene, bones: dict[int, ufbx.Node]) -> list[list[ufbx.Node]]:
    """Return the topmost joints by armature: those that share a skin, or hang on one node and are no two bodies."""
    tops = [node for node in walk(scene.root_node) if node.typed_id in bones and above(node).typed_id not in bones]
    top_of = {below.typed_id: k for k, top in enumerate(tops) for below in walk(top)}
    group = list(range(len(tops)))

    def join(first: int, second: int) -> None:
        old, new = group[second], group[first]
        group[:] = [new if one == old else one for one in group]

    for skin in scene.skin_deformers:
        members = [c.bone_node.typed_id for c in skin.clusters if c.bone_node is not None]
        used = sorted({top_of[number] for number in members if number in top_of})
        for other in used[1:]:
            join(used[0], other)
    sizes = [sum(below.typed_id in bones for below in walk(top)) for top in tops]
    for first in range(len(tops)):
        for second in range(first + 1, len(tops)):
            same = above(tops[first]).typed_id == above(tops[second]).typed_id and not above(tops[first]).is_root
            if same and min(sizes[first], sizes[second]) < _BODY_JOINTS:
                join(first, second)
    return [[top for top, own in zip(tops, group, strict=True) if own == one] for one in dict.fromkeys(group)]


def _build(scene: ufbx.Scene, tops: list[ufbx.Node], bones: dict[int, ufbx.Node]) -> Armature:
    root = tops[0] if len(tops) == 1 else _common_node(scene, tops)
    lines = {node.typed_id for top in tops for node in line_of(top)}
    joints = [node for node in walk(root) if node.typed_id in bones or node.typed_id in lines or node is root]
    ends = {above(node).typed_id: node for node in joints if _is_end(node) and node is not root}
    joints = [node for node in joints if not (node is not root and _is_end(node))]
    if len(joints) > MAX_JOINTS:
        raise Refusal(f"has an armature of {len(joints)} joints, allowed are {MAX_JOINTS}")
    place = {node.typed_id: index for index, node in enumerate(joints)}
    parents = [-1 if node is root else place[above(node).typed_id] for node in joints]
    holder = "" if root.is_root or above(root).is_root else above(root).name
    name = holder or root.name or "armature"
    return Armature(name, joints, parents, {place[number]: node for number, node in ends.items()})


def _common_node(scene: ufbx.Scene, tops: list[ufbx.Node]) -> ufbx.Node:
    lines = [line_of(top)[::-1] for top in tops]
    common = scene.root_node
    for nodes in zip(*lines, strict=False):
        if any(node is not nodes[0] for node in nodes):
            break
        common = nodes[0]
    return common


def _is_end(node: ufbx.Node) -> bool:
    """Return whether a node is the tip that exporters add to a last limb: NAME_end, alone below it."""
    return (
        node.name.lower().endswith("_end")
        and len(node.children) == 0
        and not above(node).is_root
        and len(above(node).children) == 1
    )
