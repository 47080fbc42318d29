"""Bodies in the browser, sent once and then posed: the mannequin, and a character's own mesh."""

from dataclasses import dataclass, replace

import numpy as np
import trimesh
import viser
from trimesh.visual import ColorVisuals

from mapctl.mesh.character_mesh import CharacterMesh
from mapctl.mesh.mannequin import Skin, at_rest, build_skin
from mapctl.mesh.primitives import Array
from mapctl.motion import Motion
from mapctl.retarget import RigMap
from mapctl.skeleton import Skeleton
from scenes.drawn_character import DrawnCharacter

_MAX_COLOURS = 12  # of a character's mesh
_DIGITS = 6  # decimal places of metres and weights at which vertices are the same
_NEAR = 0.03  # of a colour, 0 to 1, within which triangles are alike
_OPAQUE = 0.999


@dataclass(frozen=True, eq=False)
class BodyPose:
    """A pose, in the terms of the body that prepared it."""

    positions: Array
    """(n, 3) positions of what the body moves, metres."""
    quat_xyzw: Array
    """(n or more, 4) rotations."""


class MannequinBody:
    """The mannequin of a skeleton below a node of a scene: meshes that hang on joints."""

    def __init__(self, scene: viser.SceneApi, name: str, skeleton: Skeleton, colour: str):
        """Add the mannequin with a torso of this `colour`."""
        body, paths = build_skin(at_rest(skeleton), colour), []
        self._joints: list[viser.FrameHandle] = []
        for joint, parent in enumerate(skeleton.parents):
            paths.append(f"{paths[parent] if parent >= 0 else name}/{skeleton.names[joint]}")
            offset = skeleton.offsets[joint].numpy()
            self._joints.append(scene.add_frame(paths[joint], show_axes=False, position=offset))
            if (part := _extract_part(body, joint)) is not None:
                scene.add_mesh_trimesh(f"{paths[joint]}/skin", part)

    def prepare(self, motion: Motion) -> list[BodyPose]:
        """Prepare the poses of frames: position of the root, and local rotation of every joint."""
        roots, quats = motion.root_position.numpy(), motion.local_quat_xyzw.numpy()
        return [BodyPose(root[None], turns) for root, turns in zip(roots, quats, strict=True)]

    def pose(self, pose: BodyPose) -> None:
        """Move the root and turn the joints."""
        self._joints[0].position = pose.positions[0]
        for handle, wxyz in zip(self._joints, np.roll(pose.quat_xyzw, 1, axis=1), strict=True):
            handle.wxyz = wxyz


class SkinnedBody:
    """A character's own mesh below a node of a scene: sent with its weights, then only its bones are moved.

    The browser's skinned meshes have one colour, so there is one for every group of similar colours.
    """

    def __init__(self, scene: viser.SceneApi, name: str, character: DrawnCharacter):
        """Add the character's mesh in its rest pose."""
        self._character, mesh = character, character.mesh
        carriers = find_carriers(character.body.leveled_map)
        self._joints = np.unique(carriers)
        weights = _sum_weights(mesh, np.searchsorted(self._joints, carriers), len(self._joints))
        same = _find_same(np.column_stack([mesh.vertices, weights]))
        self._bones: list[tuple[int, viser.MeshSkinnedBoneHandle]] = []
        for number, group in enumerate(group_by_colour(mesh, _MAX_COLOURS)):
            self._add_group(scene, f"{name}/skin{number}", replace(group, faces=same[group.faces]), weights)

    def prepare(self, motion: Motion) -> list[BodyPose]:
        """Prepare the poses of frames on canonical joints with the character's bones: transforms of its bones."""
        placed = self._character.put_on(motion).placed.motion
        positions, quats = placed.joint_positions().numpy(), placed.joint_rotations().numpy()
        return [BodyPose(*pair) for pair in zip(positions[:, self._joints], quats[:, self._joints], strict=True)]

    def pose(self, pose: BodyPose) -> None:
        """Move the bones."""
        wxyz = np.roll(pose.quat_xyzw, 1, axis=1)
        for joint, bone in self._bones:
            bone.position = pose.positions[joint]
            bone.wxyz = wxyz[joint]

    def _add_group(self, scene: viser.SceneApi, name: str, group: "ColourGroup", weights: Array) -> None:
        mesh = self._character.mesh
        vertices, faces = np.unique(group.faces, return_inverse=True)
        bones = np.flatnonzero(weights[vertices].max(axis=0) > 0)
        handle = scene.add_mesh_skinned(
            name,
            mesh.vertices[vertices],
            faces.reshape(-1, 3),
            bone_wxyzs=np.tile([1.0, 0.0, 0.0, 0.0], (len(bones), 1)),
            bone_positions=mesh.rest[self._joints[bones]],
            skin_weights=weights[np.ix_(vertices, bones)],
            color=tuple((255 * group.rgba[:3]).round().astype(int).tolist()),
            opacity=None if group.rgba[3] > _OPAQUE else float(group.rgba[3]),
            side="double",
        )
        self._bones += zip(bones.tolist(), handle.bones, strict=True)


@dataclass(frozen=True, eq=False)
class ColourGroup:
    """Triangles that are shown in one colour."""

    faces: Array
    """(m, 3) vertex indices of the mesh."""
    rgba: Array
    """(4,) sRGB colour and opacity, 0 to 1: their mean by area."""


def group_by_colour(mesh: CharacterMesh, most: int) -> list[ColourGroup]:
    """Group the triangles by colour into at most so many groups, opaque ones apart from others.

    The group with the largest variance, by area, is halved at its mean along that channel (median cut, Heckbert 1982),
    until all are alike or there are enough.
    """
    corners = mesh.vertices[mesh.faces]
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    rgba, area = mesh.rgba[mesh.faces].mean(axis=1), np.linalg.norm(across, axis=1) / 2 + 1e-12
    opaque = rgba[:, 3] >= _OPAQUE
    groups = [np.flatnonzero(mask) for mask in (opaque, ~opaque) if mask.any()]
    while len(groups) < most:
        spreads = [_measure_spread(rgba[group], area[group]) for group in groups]
        worst = max(range(len(groups)), key=lambda k: spreads[k].max())
        channel = int(spreads[worst].argmax())
        values = rgba[groups[worst], channel]
        if np.ptp(values) < _NEAR:
            break
        low = values <= np.average(values, weights=area[groups[worst]])
        groups[worst : worst + 1] = [groups[worst][low], groups[worst][~low]]
    return [ColourGroup(mesh.faces[group], np.average(rgba[group], axis=0, weights=area[group])) for group in groups]


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


def _extract_part(body: Skin, joint: int) -> trimesh.Trimesh | None:
    """Extract the triangles that hang on a joint, None if there are none."""
    faces = body.faces[body.joint[body.faces[:, 0]] == joint]
    if not len(faces):
        return None
    used, packed = np.unique(faces, return_inverse=True)
    rgba = np.column_stack([body.rgb[used], np.ones(len(used))])
    mesh = trimesh.Trimesh(body.vertices[used], packed.reshape(-1, 3), vertex_normals=body.normals[used], process=False)
    mesh.visual = ColorVisuals(mesh, vertex_colors=(255 * rgba).round().astype(np.uint8))
    return mesh


def _measure_spread(rgba: Array, area: Array) -> Array:
    """Return by channel the variance times the area."""
    spread = (area[:, None] * (rgba - np.average(rgba, axis=0, weights=area)) ** 2).sum(axis=0)
    return np.where(np.ptp(rgba, axis=0) < _NEAR, 0.0, spread)


def _find_same(rows: Array) -> Array:
    """Return for each row the first of those that are the same: a browser shades smoothly over shared vertices only,
    and files have several where texture charts meet."""
    _, first, number = np.unique(rows.round(_DIGITS), axis=0, return_index=True, return_inverse=True)
    return first[number.reshape(-1)]


def _sum_weights(mesh: CharacterMesh, bone: Array, count: int) -> Array:
    """Return the weights of bones (n, bones), by joint the `bone` that carries it."""
    summed = np.zeros((len(mesh.vertices), count))
    rows = np.arange(len(mesh.vertices))
    for joints, weights in zip(mesh.joints.T, mesh.weights.T, strict=True):
        np.add.at(summed, (rows, bone[joints]), weights)
    return summed
