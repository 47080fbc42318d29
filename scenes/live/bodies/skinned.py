"""A character's own mesh in the browser: sent once with its weights, then only its bones are moved."""

from dataclasses import replace

import numpy as np
import viser

from mapctl.mesh.character_mesh import CharacterMesh
from mapctl.mesh.primitives import Array
from mapctl.motion import Motion
from mapctl.retarget import RigMap
from scenes.drawn_character import DrawnCharacter
from scenes.live.bodies.body import BodyPose
from scenes.live.bodies.colour_groups import ColourGroup, part_by_colour

_MOST_COLOURS = 12
_DIGITS = 6  # decimal places of metres and shares at which vertices are the same


class LiveCharacterBody:
    """A character below a node of a scene.

    The browser's skinned meshes have one colour, so there is one for every group of similar colours.
    """

    def __init__(self, scene: viser.SceneApi, name: str, character: DrawnCharacter):
        """Add the character's mesh in its rest pose."""
        self._character, mesh = character, character.mesh
        carriers = find_carriers(character.body.leveled_map)
        self._joints = np.unique(carriers)
        shares = _sum_shares(mesh, np.searchsorted(self._joints, carriers), len(self._joints))
        same = _find_same(np.column_stack([mesh.vertices, shares]))
        self._bones: list[tuple[int, viser.MeshSkinnedBoneHandle]] = []
        for number, group in enumerate(part_by_colour(mesh, _MOST_COLOURS)):
            self._add_group(scene, f"{name}/skin{number}", replace(group, faces=same[group.faces]), shares)

    def prepare(self, motion: Motion) -> list[BodyPose]:
        """Prepare the poses of frames on canonical joints with the character's bones: where its moving joints are."""
        placed = self._character.put_on(motion).placed.motion
        places, turns = placed.joint_positions().numpy(), placed.joint_rotations().numpy()
        return [BodyPose(*pair) for pair in zip(places[:, self._joints], turns[:, self._joints], strict=True)]

    def pose(self, pose: BodyPose) -> None:
        """Move the bones."""
        wxyz = np.roll(pose.quat_xyzw, 1, axis=1)
        for joint, bone in self._bones:
            bone.position = pose.positions[joint]
            bone.wxyz = wxyz[joint]

    def _add_group(self, scene: viser.SceneApi, name: str, group: ColourGroup, shares: Array) -> None:
        mesh = self._character.mesh
        vertices, faces = np.unique(group.faces, return_inverse=True)
        bones = np.flatnonzero(shares[vertices].max(axis=0) > 0)
        handle = scene.add_mesh_skinned(
            name,
            mesh.vertices[vertices],
            faces.reshape(-1, 3),
            bone_wxyzs=np.tile([1.0, 0.0, 0.0, 0.0], (len(bones), 1)),
            bone_positions=mesh.rest[self._joints[bones]],
            skin_weights=shares[np.ix_(vertices, bones)],
            color=tuple((255 * group.rgba[:3]).round().astype(int).tolist()),
            opacity=None if group.rgba[3] > 0.999 else float(group.rgba[3]),
            side="double",
        )
        self._bones += zip(bones.tolist(), handle.bones, strict=True)


def find_carriers(rigmap: RigMap) -> Array:
    """Return by joint of a rig the joint with which it moves as one: itself if it is a canonical one, or rests in
    another pose than the file's; else that of its parent, as fingers move with their hand."""
    parents, moving = rigmap.rig_skeleton.parents, set(rigmap.joints.values())
    still = rigmap.idle_quat_xyzw[:, 3].abs() > 1 - 1e-9
    moving |= {joint for joint in range(len(parents)) if not still[joint]}
    found: list[int] = []
    for joint, parent in enumerate(parents):
        found.append(joint if joint in moving or parent < 0 else found[parent])
    return np.array(found)


def _find_same(rows: Array) -> Array:
    """Return for each row the first of those that are the same: a browser's light is smooth over shared vertices
    only, and files have several at a place where pictures meet."""
    _, first, number = np.unique(rows.round(_DIGITS), axis=0, return_index=True, return_inverse=True)
    return first[number.reshape(-1)]


def _sum_shares(mesh: CharacterMesh, bone: Array, count: int) -> Array:
    """Return the shares of bones (n, bones), by joint the `bone` that carries it."""
    shares = np.zeros((len(mesh.vertices), count))
    rows = np.arange(len(mesh.vertices))
    for joints, weights in zip(mesh.joints.T, mesh.weights.T, strict=True):
        np.add.at(shares, (rows, bone[joints]), weights)
    return shares
