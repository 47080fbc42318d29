"""The joints of an armature as mapctl gets them: heads of bones, in a world of metres with Y up."""

from dataclasses import dataclass, field

import bpy
import numpy as np

from ..problem import AddonError

Y_UP = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
"""From Blender's axes, Z up and facing -Y, to mapctl's, Y up and facing +Z."""
_UNEVEN = 1e-3  # what scales may differ by, relative
_FEWEST = 10  # bones that deform, from which on the others are left out


@dataclass(frozen=True)
class Control:
    """A bone of a generated rig that is keyed so that joints come out where they should."""

    bone: str
    """Name of the control."""
    joint: int
    """Joint with which it moves as one."""
    carrier: int | None
    """Joint with which it moves while it is not keyed itself; None for the armature."""
    travels: bool = False
    """Whether its location is keyed, too."""


@dataclass(frozen=True, eq=False)
class Body:
    """Joints, parents first, and the bones that show how they are."""

    names: tuple[str, ...]
    """Joint names: those of the bones that deform."""
    bones: tuple[str, ...]
    """Bone that moves with each joint."""
    parents: tuple[int, ...]
    """Index of each joint's parent; -1 for joint 0."""
    heads: np.ndarray
    """Joints at rest in the armature's space, (joints, 3)."""
    rests: np.ndarray
    """Matrices of `bones` at rest in the armature's space, (joints, 4, 4)."""
    ends: dict[str, np.ndarray]
    """Tails of last bones in the armature's space, by joint."""
    frame: np.ndarray
    """From the armature's space to mapctl's axes and metres as it is turned and scaled, without its place, (4, 4)."""
    movable: frozenset[int] = frozenset()
    """Joints that may travel within their parent."""
    controls: tuple[Control, ...] = ()
    """What is keyed of a generated rig; where there are none, `bones` are."""
    switches: dict[str, str] = field(default_factory=dict)
    """Custom property of a bone of a generated rig that is keyed to 1, by bone."""
    rig_toml: str = ""
    """What mapctl is told of the joints by a rig file; nothing where it finds out itself."""

    def to_world(self, places: np.ndarray) -> np.ndarray:
        """Convert places (..., 3) in the armature's space to mapctl's, with the armature at the origin."""
        return places @ self.frame[:3, :3].T


def measure_world(armature: bpy.types.Object, scene: bpy.types.Scene) -> np.ndarray:
    """Measure how the armature's space lies in mapctl's world now, (4, 4); AddonError for scales that deform it."""
    matrix = np.array(armature.matrix_world, dtype=np.float64)
    gram = matrix[:3, :3].T @ matrix[:3, :3]
    even = np.trace(gram) / 3
    if not np.allclose(gram, even * np.eye(3), atol=_UNEVEN * even) or even == 0:
        raise AddonError(f"{armature.name} is scaled unevenly: apply its scale (Object > Apply > Scale)")
    if np.linalg.det(matrix[:3, :3]) < 0:
        raise AddonError(f"{armature.name} is mirrored by a negative scale: apply its scale (Object > Apply > Scale)")
    turned = np.eye(4)
    turned[:3] = Y_UP @ matrix[:3] * scene.unit_settings.scale_length
    return turned


def measure_frame(armature: bpy.types.Object, scene: bpy.types.Scene) -> np.ndarray:
    """Measure the same without the armature's place."""
    turned = measure_world(armature, scene)
    turned[:3, 3] = 0.0
    return turned


def take_bones(armature: bpy.types.Object, scene: bpy.types.Scene) -> Body:
    """Take the bones of an armature as joints: the tree in which most bones deform, down to the last of these.

    AddonError for an armature without bones.
    """
    trees = [[root, *root.children_recursive] for root in armature.data.bones if root.parent is None]
    if not trees:
        raise AddonError(f"{armature.name} has no bones")
    whole = max(trees, key=lambda tree: (sum(bone.use_deform for bone in tree), len(tree)))
    needed = {bone.name for bone in whole if bone.use_deform or any(b.use_deform for b in bone.children_recursive)}
    bones = _order([bone for bone in whole if len(needed) < _FEWEST or bone.name in needed])
    numbers = {bone.name: number for number, bone in enumerate(bones)}
    last = set(numbers) - {bone.parent.name for bone in bones if bone.parent}
    return Body(
        names=tuple(numbers),
        bones=tuple(numbers),
        parents=tuple(numbers[bone.parent.name] if bone.parent else -1 for bone in bones),
        heads=np.array([bone.head_local for bone in bones], dtype=np.float64),
        rests=np.array([bone.matrix_local for bone in bones], dtype=np.float64),
        ends={bone.name: np.array(bone.tail_local, dtype=np.float64) for bone in bones if bone.name in last},
        frame=measure_frame(armature, scene),
        movable=frozenset(number for number, bone in enumerate(bones) if bone.parent and not bone.use_connect),
    )


def _order(bones: list[bpy.types.Bone]) -> list[bpy.types.Bone]:
    """Order bones so that parents come first."""
    return sorted(bones, key=lambda bone: len(bone.parent_recursive))
