"""The mannequin in the browser sent once, skinned to joints that are then rotated."""

import numpy as np
import trimesh
import viser
from trimesh.visual import ColorVisuals

from mapctl.mesh.skinning import Skin, at_rest, build_skin
from mapctl.motion import Motion
from mapctl.skeleton import Skeleton
from scenes.live.bodies.body import BodyPose


class LiveMannequin:
    """The mannequin of a skeleton below a node of a scene."""

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
        """Prepare the poses of delivered frames: position of the root, and local rotation of every joint."""
        roots, quats = motion.root_position.numpy(), motion.local_quat_xyzw.numpy()
        return [BodyPose(root[None], turns) for root, turns in zip(roots, quats, strict=True)]

    def pose(self, pose: BodyPose) -> None:
        """Move the root and turn the joints."""
        self._joints[0].position = pose.positions[0]
        for handle, (x, y, z, w) in zip(self._joints, pose.quat_xyzw, strict=True):
            handle.wxyz = (w, x, y, z)


def _extract_part(body: Skin, joint: int) -> trimesh.Trimesh | None:
    """Extract the triangles that hang on a joint, None if there are none."""
    faces = body.faces[body.joint[body.faces[:, 0]] == joint]
    if not len(faces):
        return None
    used, packed = np.unique(faces, return_inverse=True)
    colours = np.column_stack([body.rgb[used], np.ones(len(used))])
    mesh = trimesh.Trimesh(body.vertices[used], packed.reshape(-1, 3), vertex_normals=body.normals[used], process=False)
    mesh.visual = ColorVisuals(mesh, vertex_colors=(255 * colours).round().astype(np.uint8))
    return mesh
