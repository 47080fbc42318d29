"""A character's own mesh as the body of an actor."""

from functools import cached_property

import numpy as np

from mapctl import rotations
from mapctl.errors import MapctlError
from mapctl.mesh.anatomy import Anatomy
from mapctl.mesh.body import Body
from mapctl.mesh.character_mesh import CharacterMesh
from mapctl.mesh.primitives import Array, Surface, unit
from mapctl.motion import Motion


class SkinnedBody:
    """The mesh of a character, moved by its joints; its bones and marks are those of another body in the same place."""

    def __init__(self, mesh: CharacterMesh, motion: Motion, bones: Body):
        """`motion` is on the joints of the mesh, frame by frame that of `bones`. MapctlError where it is not."""
        if motion.num_joints != len(mesh.rest) or motion.num_frames != bones.num_frames:
            told = f"{motion.num_joints} joints and {motion.num_frames} frames"
            raise MapctlError(f"a mesh of {len(mesh.rest)} joints and {bones.num_frames} frames got {told}")
        self._mesh, self._bones = mesh, bones
        self._places = motion.joint_positions().numpy()
        self._turns = rotations.to_matrix(motion.joint_rotations()).numpy()

    @property
    def anatomy(self) -> Anatomy:
        """Hips, head and soles."""
        return self._bones.anatomy

    @property
    def num_frames(self) -> int:
        """Frames of the motion."""
        return self._bones.num_frames

    @property
    def seen(self) -> Array:
        """Positions (frames, n, 3) of its bones, and of the vertices that are outermost at rest, metres."""
        return self._seen

    @cached_property
    def _seen(self) -> Array:
        vertices = self._mesh.vertices
        outer = np.concatenate([vertices.argmin(axis=0), vertices.argmax(axis=0)])
        joint = self._mesh.joints[outer, self._mesh.weights[outer].argmax(axis=1)]
        turned = np.einsum("fnab,nb->fna", self._turns[:, joint], vertices[outer] - self._mesh.rest[joint])
        return np.concatenate([self._bones.seen, self._places[:, joint] + turned], axis=1)

    def surface(self, frame: int) -> Surface:
        """Return the mesh in one frame; it is open, as clothes and hair are, and seen from both sides."""
        vertices, normals = self._mesh.pose(self._places[frame], self._turns[frame])
        fine = self._mesh.fine
        if fine is None:
            return Surface(vertices, self._mesh.faces, self._mesh.rgba, normals, is_open=True)
        return Surface(fine.spread(vertices), fine.faces, fine.rgba, unit(fine.spread(normals)), is_open=True)

    def sticks(self, frame: int) -> tuple[Array, Array, Array]:
        """Return all bones in one frame: ends (n, 2, 3) and radii (n,) in metres, colours (n, 3) sRGB."""
        return self._bones.sticks(frame)
