"""Between a character file's own joint frames and those of a `Motion`, which are aligned with the world at rest.

A file turns a joint in a frame that its modeller chose; a `Motion` that comes from it turns it about the world's axes,
so that all rotations zero are the rest pose, whatever the file's frames are. With R_j a joint's world rotation at rest
and G_j that of a frame: rotation of the motion in the world = G_j * inverse(R_j).
"""

from collections.abc import Mapping
from dataclasses import dataclass
from fractions import Fraction

import numpy as np
import torch

from mapctl import kinematics, rotations
from mapctl.motion import Motion
from mapctl.skeleton import Skeleton

Array = np.ndarray
STILL_METRES = 1e-5
"""A joint whose offset varies by less stays still; files of 32-bit numbers round to 1e-7 of a body."""


class UnevenScaleError(ValueError):
    """A matrix stretches by different factors along its axes, mirrors, or shears; `args[0]` says which, `joint` of
    which joint, where it is one of several."""

    joint: int = 0


@dataclass(frozen=True, eq=False)
class RestFrames:
    """A character's joints as its file has them at rest, in a world with Y up and in metres."""

    names: tuple[str, ...]
    """Joint names, unique, joint 0 the root."""
    parents: tuple[int, ...]
    """Index of each joint's parent, -1 for the root."""
    positions: Array
    """(joints, 3) at rest, metres."""
    quat_xyzw: Array
    """(joints, 4) world rotations at rest."""
    scales: Array
    """(joints,) metres of the world by unit of the joint's frame; negative for a last joint that mirrors."""
    outer: Array
    """(4, 4) what takes the frame that the root is in to the world: placement, up axis and unit of the file."""

    @staticmethod
    def of(names: tuple[str, ...], parents: tuple[int, ...], worlds: Array, outer: Array) -> "RestFrames":
        """Take them from world matrices (joints, 4, 4) at rest. UnevenScaleError names a joint that is stretched."""
        try:
            turns, scales = split_scales(parents, worlds)
        except UnevenScaleError as error:
            raise UnevenScaleError(f"joint {names[error.joint]}: {error}") from None
        split_scale(outer)
        quats = rotations.from_matrix(torch.from_numpy(turns)).numpy()
        return RestFrames(names, parents, worlds[:, :3, 3].copy(), quats, scales, outer)

    @property
    def are_aligned(self) -> bool:
        """Whether the file's own joint frames are aligned with the world at rest."""
        return bool(np.allclose(np.abs(self.quat_xyzw[:, 3]), 1.0, atol=1e-6))

    def matrices(self) -> Array:
        """Return the joints' world matrices at rest, (joints, 4, 4)."""
        return compose_matrices(self.positions, self.quat_xyzw, np.repeat(self.scales[:, None], 3, axis=1))

    def with_root(self, name: str) -> "RestFrames":
        """Return the same joints below a further one, which at rest is where the frame is that the root is in."""
        turn, scale = split_scale(self.outer)
        quat = rotations.from_matrix(torch.from_numpy(turn)).numpy()
        return RestFrames(
            (name, *self.names),
            (-1, *(parent + 1 for parent in self.parents)),
            np.vstack([self.outer[:3, 3], self.positions]),
            np.vstack([quat, self.quat_xyzw]),
            np.concatenate([[scale], self.scales]),
            self.outer,
        )

    def skeleton(self, end_positions: Mapping[int, Array]) -> Skeleton:
        """Return the skeleton whose frames are aligned with the world; `end_positions` are those of End Sites at rest,
        by joint, metres."""
        offsets = self.positions - self.positions[[max(parent, 0) for parent in self.parents]]
        ends = {self.names[j]: tuple((end - self.positions[j]).tolist()) for j, end in end_positions.items()}
        return Skeleton(self.names, self.parents, torch.from_numpy(offsets), ends)

    def to_motion(self, worlds: Array, fps: Fraction, skeleton: Skeleton, source: object) -> Motion:
        """Return the motion of world matrices (frames, joints, 4, 4) in the file's joint frames."""
        turns = torch.from_numpy(nearest_rotations(np.sign(self.scales)[:, None, None] * worlds[..., :3, :3]))
        world = rotations.multiply(
            rotations.from_matrix(turns),
            rotations.inverse(torch.from_numpy(self.quat_xyzw)).expand(*worlds.shape[:2], 4),
        )
        places = torch.from_numpy(worlds[..., :3, 3].copy())
        local = rotations.make_sign_continuous(kinematics.local_from_world(self.parents, world))
        moving = {}
        for joint, parent in enumerate(self.parents[1:], start=1):
            offset = rotations.rotate(rotations.inverse(world[:, parent]), places[:, joint] - places[:, parent])
            if float((offset - skeleton.offsets[joint]).abs().max()) > STILL_METRES:
                moving[joint] = offset
        return Motion(skeleton, fps, places[:, 0], local, moving, source)

    def to_locals(self, motion: Motion) -> tuple[Array, Array]:
        """Return translations (frames, joints, 3) and rotations (frames, joints, 4), xyzw, in the file's frames: of
        each joint in its parent's, of the root in the frame that `outer` takes to the world."""
        frames = motion.num_frames
        rest = torch.from_numpy(self.quat_xyzw).expand(frames, -1, -1)
        world = rotations.multiply(motion.joint_rotations(), rest)
        turn, unit = split_scale(self.outer)
        base = rotations.from_matrix(torch.from_numpy(turn)).expand(frames, 4)
        origin, places = torch.from_numpy(self.outer[:3, 3].copy()), motion.joint_positions()
        moved, turned = torch.empty_like(places), torch.empty_like(world)
        for joint, parent in enumerate(self.parents):
            above = base if parent < 0 else world[:, parent]
            start = origin.expand(frames, 3) if parent < 0 else places[:, parent]
            back, scale = rotations.inverse(above), unit if parent < 0 else self.scales[parent]
            moved[:, joint] = rotations.rotate(back, places[:, joint] - start) / scale
            turned[:, joint] = rotations.multiply(back, world[:, joint])
        return moved.numpy(), rotations.make_sign_continuous(turned).numpy()


def split_scales(parents: tuple[int, ...], worlds: Array) -> tuple[Array, Array]:
    """Return rotations (joints, 3, 3) and scales (joints,) of world matrices (joints, 4, 4).

    UnevenScaleError as of `split_scale`; but last joints, in whose frames no other is, may mirror.
    """
    turns, scales = np.empty((len(parents), 3, 3)), np.empty(len(parents))
    for joint, matrix in enumerate(worlds):
        try:
            turns[joint], scales[joint] = split_scale(matrix, may_mirror=joint not in parents)
        except UnevenScaleError as error:
            error.joint = joint
            raise
    return turns, scales


def split_scale(matrix: Array, *, may_mirror: bool = False) -> tuple[Array, float]:
    """Return rotation (3, 3) and scale of a (4, 4) matrix that turns and scales alike along all axes.

    UnevenScaleError where it does not: where it stretches, mirrors or shears by more than a thousandth. One that
    `may_mirror` has a negative scale where it does.
    """
    linear, sign = matrix[:3, :3], 1.0
    if may_mirror and np.linalg.det(linear) < 0:
        linear, sign = -linear, -1.0
    lengths = np.linalg.norm(linear, axis=0)
    scale = float(np.cbrt(abs(np.linalg.det(linear))))
    if not scale > 1e-9:
        raise UnevenScaleError("its scale is zero")
    if np.linalg.det(linear) < 0:
        raise UnevenScaleError("its scale is negative, which mirrors")
    if not np.allclose(lengths, scale, rtol=1e-3) or not np.allclose(
        linear.T @ linear, scale**2 * np.eye(3), atol=2e-3 * scale**2
    ):
        raise UnevenScaleError(f"its scale is not the same along all axes ({', '.join(f'{x:.4g}' for x in lengths)})")
    return nearest_rotations(linear), sign * scale


def nearest_rotations(linear: Array) -> Array:
    """Return the rotations (..., 3, 3) nearest to matrices (..., 3, 3), by singular values."""
    left, _, right = np.linalg.svd(linear)
    flip = np.ones(linear.shape[:-1])
    flip[..., -1] = np.linalg.det(left @ right)
    return (left * flip[..., None, :]) @ right


def compose_matrices(translations: Array, quat_xyzw: Array, scales: Array) -> Array:
    """Return matrices (..., 4, 4) that scale by (..., 3), then turn by (..., 4), then move by (..., 3)."""
    turns = rotations.to_matrix(torch.from_numpy(np.ascontiguousarray(quat_xyzw))).numpy()
    matrices = np.zeros((*turns.shape[:-2], 4, 4))
    matrices[..., :3, :3] = turns * scales[..., None, :]
    matrices[..., :3, 3] = translations
    matrices[..., 3, 3] = 1.0
    return matrices


def chain_matrices(parents: tuple[int, ...], local: Array, outer: Array) -> Array:
    """Return world matrices (..., joints, 4, 4) of local ones; `outer` (4, 4) takes the root's frame to the world."""
    worlds = np.empty_like(local)
    for joint, parent in enumerate(parents):
        worlds[..., joint, :, :] = (outer if parent < 0 else worlds[..., parent, :, :]) @ local[..., joint, :, :]
    return worlds
