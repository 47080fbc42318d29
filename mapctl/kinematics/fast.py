"""Root integration and forward kinematics of a trial, compiled, with adjoints written by hand, on one core.

`features.integrate_root` and `kinematics.positions_from_matrices` remain the specification, and serve every case but
float32 on the CPU. Both are one node of torch's graph, differentiable once. Kernels compute in float64 whatever the
arrays hold, so that sums over frames stay exact.
"""

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.autograd.function import once_differentiable

from mapctl.features import LAYOUT, GroundPose
from mapctl.numerics.jit import make_jit_decorators
from mapctl.skeleton import FEET, Skeleton, find_heels

entry, inner = make_jit_decorators("contract", "nsz")

_SERIES_THRESHOLD = 1e-2  # squared radians below which the series are exact to 1e-10 and the quotients begin to cancel


@entry
def root_forward(features, columns, start_xz, start_heading, ground, headings):
    """Integrate features (batch, frames, size) by Eq. 4; fill ground (batch, frames, 2), headings (batch, frames)."""
    dx, dz, turn = columns.dx, columns.dz, columns.turn
    for b in range(len(features)):
        x, z, heading = np.float64(start_xz[b, 0]), np.float64(start_xz[b, 1]), np.float64(start_heading[b])
        for t in range(features.shape[1]):
            now = features[b, t]
            sine, cosine = math.sin(heading), math.cos(heading)
            x += cosine * now[dx] + sine * now[dz]
            z += cosine * now[dz] - sine * now[dx]
            heading += now[turn]
            ground[b, t, 0], ground[b, t, 1], headings[b, t] = x, z, heading


@entry
def root_backward(features, columns, start_heading, d_ground, d_headings, d_features):
    """Apply the adjoint of `root_forward`; fill the root's columns of d_features, which come in as zeros."""
    dx, dz, turn = columns.dx, columns.dz, columns.turn
    for b in range(len(features)):
        heading = np.float64(start_heading[b])
        for t in range(features.shape[1]):
            heading += features[b, t, turn]
        gx, gz, gh = 0.0, 0.0, 0.0  # on the position and the heading after the frame
        for t in range(features.shape[1] - 1, -1, -1):
            now, out = features[b, t], d_features[b, t]
            gx, gz, gh = gx + d_ground[b, t, 0], gz + d_ground[b, t, 1], gh + d_headings[b, t]
            heading -= now[turn]
            sine, cosine = math.sin(heading), math.cos(heading)
            out[dx], out[dz], out[turn] = cosine * gx - sine * gz, sine * gx + cosine * gz, gh
            gh += gx * (cosine * now[dz] - sine * now[dx]) - gz * (sine * now[dz] + cosine * now[dx])


@inner
def rotation_series(square):
    """Return sin(a)/a, (1 - cos a)/a^2 and (a - sin a)/a^3 of an angle a, from its square; smooth at 0."""
    if square < _SERIES_THRESHOLD:
        first = 1.0 - square / 6.0 * (1.0 - square / 20.0 * (1.0 - square / 42.0))
        second = 0.5 - square / 24.0 * (1.0 - square / 30.0 * (1.0 - square / 56.0))
        third = 1.0 / 6.0 - square / 120.0 * (1.0 - square / 42.0 * (1.0 - square / 72.0))
        return first, second, third
    angle = math.sqrt(square)
    first = math.sin(angle) / angle
    return first, (1.0 - math.cos(angle)) / square, (1.0 - first) / square


@inner
def compose_rotation(world, above, x, y, z):
    """Set world = above exp([x y z]): a frame rotated by a rotation vector given in it (Rodrigues)."""
    first, second, _ = rotation_series(x * x + y * y + z * z)
    r00, r11, r22 = 1.0 - second * (y * y + z * z), 1.0 - second * (x * x + z * z), 1.0 - second * (x * x + y * y)
    r01, r10 = second * x * y - first * z, second * x * y + first * z
    r02, r20 = second * x * z + first * y, second * x * z - first * y
    r12, r21 = second * y * z - first * x, second * y * z + first * x
    for i in range(3):
        a0, a1, a2 = above[i, 0], above[i, 1], above[i, 2]
        world[i, 0] = a0 * r00 + a1 * r10 + a2 * r20
        world[i, 1] = a0 * r01 + a1 * r11 + a2 * r21
        world[i, 2] = a0 * r02 + a1 * r12 + a2 * r22


@inner
def fill_rotation_about_y(turn, heading):
    """Fill the matrix of a rotation about +Y."""
    sine, cosine = math.sin(heading), math.cos(heading)
    turn[0, 0], turn[0, 1], turn[0, 2] = cosine, 0.0, sine
    turn[1, 0], turn[1, 1], turn[1, 2] = 0.0, 1.0, 0.0
    turn[2, 0], turn[2, 1], turn[2, 2] = -sine, 0.0, cosine


@entry
def body_forward(features, columns, ground, headings, bones, positions, heels, world):
    """Fill positions (batch, frames, joints, 3) and rotations `world` (batch, frames, joints, 3, 3) of every joint, and
    the positions of the heels (batch, frames, 2, 3). `bones` are those of `Bones`."""
    parents, offsets, feet, heel_offsets = bones.parents, bones.offsets, bones.feet, bones.heels
    heading_frame = np.empty((3, 3))
    for b in range(len(features)):
        for t in range(features.shape[1]):
            now, at, frames = features[b, t], positions[b, t], world[b, t]
            fill_rotation_about_y(heading_frame, np.float64(headings[b, t]))
            compose_rotation(
                frames[0], heading_frame, np.float64(now[columns.tilt_x]), 0.0, np.float64(now[columns.tilt_z])
            )
            at[0, 0], at[0, 1], at[0, 2] = ground[b, t, 0], now[columns.height], ground[b, t, 1]
            for joint in range(1, len(parents)):
                above, bone, vector = frames[parents[joint]], offsets[joint], columns.joints + 3 * (joint - 1)
                for i in range(3):
                    step = above[i, 0] * bone[0] + above[i, 1] * bone[1] + above[i, 2] * bone[2]
                    at[joint, i] = at[parents[joint], i] + step
                compose_rotation(
                    frames[joint],
                    above,
                    np.float64(now[vector]),
                    np.float64(now[vector + 1]),
                    np.float64(now[vector + 2]),
                )
            for side in range(len(feet)):
                above, bone, foot = frames[feet[side]], heel_offsets[side], feet[side]
                for i in range(3):
                    step = above[i, 0] * bone[0] + above[i, 1] * bone[1] + above[i, 2] * bone[2]
                    heels[b, t, side, i] = at[foot, i] + step


@inner
def rotation_vector_gradient(world, torque, x, y, z):
    """Return the gradient to a joint's rotation vector from the torque about it: the right Jacobian's transpose."""
    ux = world[0, 0] * torque[0] + world[1, 0] * torque[1] + world[2, 0] * torque[2]
    uy = world[0, 1] * torque[0] + world[1, 1] * torque[1] + world[2, 1] * torque[2]
    uz = world[0, 2] * torque[0] + world[1, 2] * torque[1] + world[2, 2] * torque[2]
    _, second, third = rotation_series(x * x + y * y + z * z)
    cx, cy, cz = y * uz - z * uy, z * ux - x * uz, x * uy - y * ux
    return (
        ux + second * cx + third * (y * cz - z * cy),
        uy + second * cy + third * (z * cx - x * cz),
        uz + second * cz + third * (x * cy - y * cx),
    )


@entry
def body_backward(features, columns, bones, world, d_positions, d_heels, d_features, d_ground, d_headings):
    """Apply the adjoint of `body_forward`, by forces and torques as in statics.

    A gradient on a position is a force there. The gradient of a joint's rotation is the torque about that joint of the
    forces on all its descendants; both are summed from the leaves to the root. Fills the body's columns of
    d_features, which come in as zeros, d_ground and d_headings.
    """
    parents, offsets, feet, heel_offsets = bones.parents, bones.offsets, bones.feet, bones.heels
    pulled, still = np.empty(3), np.zeros(3)
    force, torque = np.empty((len(parents), 3)), np.empty((len(parents), 3))
    for b in range(len(features)):
        for t in range(features.shape[1]):
            now, out, frames = features[b, t], d_features[b, t], world[b, t]
            for joint in range(len(parents)):  # written out: slices take as long as all the rest to compile
                for i in range(3):
                    force[joint, i], torque[joint, i] = d_positions[b, t, joint, i], 0.0
            for side in range(len(feet)):
                foot = feet[side]
                for i in range(3):
                    pulled[i] = d_heels[b, t, side, i]
                accumulate_to_parent(frames[foot], heel_offsets[side], pulled, still, force[foot], torque[foot])
            for joint in range(len(parents) - 1, 0, -1):
                v = columns.joints + 3 * (joint - 1)
                out[v], out[v + 1], out[v + 2] = rotation_vector_gradient(
                    frames[joint], torque[joint], np.float64(now[v]), np.float64(now[v + 1]), np.float64(now[v + 2])
                )
                accumulate_to_parent(
                    frames[parents[joint]],
                    offsets[joint],
                    force[joint],
                    torque[joint],
                    force[parents[joint]],
                    torque[parents[joint]],
                )
            out[columns.tilt_x], _, out[columns.tilt_z] = rotation_vector_gradient(
                frames[0], torque[0], np.float64(now[columns.tilt_x]), 0.0, np.float64(now[columns.tilt_z])
            )
            out[columns.height] = force[0, 1]
            d_ground[b, t, 0], d_ground[b, t, 1], d_headings[b, t] = force[0, 0], force[0, 2], torque[0, 1]


@inner
def accumulate_to_parent(above, bone, force, torque, force_above, torque_above):
    """Add a joint's force and torque to its parent's; the force's lever is the bone between them."""
    x = above[0, 0] * bone[0] + above[0, 1] * bone[1] + above[0, 2] * bone[2]
    y = above[1, 0] * bone[0] + above[1, 1] * bone[1] + above[1, 2] * bone[2]
    z = above[2, 0] * bone[0] + above[2, 1] * bone[1] + above[2, 2] * bone[2]
    torque_above[0] += torque[0] + (y * force[2] - z * force[1])
    torque_above[1] += torque[1] + (z * force[0] - x * force[2])
    torque_above[2] += torque[2] + (x * force[1] - y * force[0])
    for i in range(3):
        force_above[i] += force[i]


class FeatureColumns(NamedTuple):
    """Where a feature vector holds what kinematics needs."""

    dx: int
    dz: int
    turn: int
    height: int
    tilt_x: int
    tilt_z: int
    joints: int


class Bones(NamedTuple):
    """A skeleton's tree with its heels, which are points of the feet."""

    parents: np.ndarray
    offsets: np.ndarray
    """(joints, 3): each joint in its parent's frame, metres, float64."""
    feet: np.ndarray
    """Indices of the left and the right foot joint."""
    heels: np.ndarray
    """(2, 3): the heels in the frames of the feet, metres, float64."""


_STEP, _TILT = LAYOUT.slices["root_displacement_heading"].start, LAYOUT.slices["root_tilt"].start
_COLUMNS = FeatureColumns(
    _STEP,
    _STEP + 1,
    LAYOUT.slices["heading_change"].start,
    LAYOUT.slices["root_height"].start,
    _TILT,
    _TILT + 1,
    LAYOUT.slices["joint_rotations"].start,
)
_JOINTS = 1 + (LAYOUT.slices["joint_rotations"].stop - LAYOUT.slices["joint_rotations"].start) // 3


def is_supported(features: Tensor, start: GroundPose, skeleton: Skeleton) -> bool:
    """Return whether the kernels support these: float32 batches on the CPU, and gradients to the features alone."""
    known = (features, start.position_xz, start.heading)
    plain = all(values.dtype == torch.float32 and values.device.type == "cpu" for values in known)
    constant = not (start.position_xz.requires_grad or start.heading.requires_grad or skeleton.offsets.requires_grad)
    shapes = (torch.Size(), torch.Size((1,)), features.shape[:1])
    fits = features.ndim == 3 and start.heading.shape in shapes and start.position_xz.shape[:-1] in shapes
    return plain and constant and fits and skeleton.num_joints == _JOINTS


def compute_world_poses(
    features: Float[Tensor, "batch frames size"], start: GroundPose, skeleton: Skeleton
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Compute ground projections of the hips and their headings (Wang et al. 2019, Eq. 4), world positions of joints,
    and of the left and the right heel (see `skeleton.find_heels`): metres, and radians that are not wrapped."""
    return _World.apply(features, start, skeleton)


@dataclass(frozen=True, eq=False)
class WorldPoses:
    """Roots and joints of candidate windows in the world, without torch's graph, and the adjoint of how they came."""

    root_xz_world: Float[Tensor, "batch frames 2"]
    """Ground projection of the hips, metres."""
    heading: Float[Tensor, "batch frames"]
    """Heading of the hips, radians about +Y, not wrapped."""
    joints_world: Float[Tensor, "batch frames joints 3"]
    """World joint positions, metres."""
    heels_world: Float[Tensor, "batch frames 2 3"]
    """World positions of the left and the right heel, metres."""
    _features: np.ndarray
    _start_heading: np.ndarray
    _bones: Bones
    _rotations: np.ndarray

    @staticmethod
    def compute(features: Float[Tensor, "batch frames size"], start: GroundPose, skeleton: Skeleton) -> "WorldPoses":
        """Compute the poses of features; what `is_supported` refuses is no input."""
        batch, bones, known = len(features), _tabulate_bones(skeleton), _contiguous_array(features)
        at, start_heading = start.position_xz.expand(batch, 2).contiguous(), start.heading.expand(batch).contiguous()
        ground, heading = features.new_empty(*known.shape[:2], 2), features.new_empty(known.shape[:2])
        root_forward(known, _COLUMNS, at.numpy(), start_heading.numpy(), ground.numpy(), heading.numpy())
        positions, heels = (
            features.new_empty(*known.shape[:2], len(points), 3) for points in (bones.offsets, bones.heels)
        )
        turns = np.empty((*positions.shape, 3), np.float32)
        body_forward(known, _COLUMNS, ground.numpy(), heading.numpy(), bones, positions.numpy(), heels.numpy(), turns)
        return WorldPoses(ground, heading, positions, heels, known, start_heading.numpy(), bones, turns)

    def pull_back(
        self, d_root_xz: np.ndarray, d_heading: np.ndarray, d_joints: np.ndarray, d_heels: np.ndarray
    ) -> np.ndarray:
        """Return the gradient on the features (batch, frames, size) from those on roots, headings, joints and heels."""
        gradient, (batch, frames, _) = np.zeros(self._features.shape, np.float32), self._features.shape
        ground, heading = np.empty((batch, frames, 2), np.float32), np.empty((batch, frames), np.float32)
        body_backward(
            self._features, _COLUMNS, self._bones, self._rotations, d_joints, d_heels, gradient, ground, heading
        )
        ground += d_root_xz
        heading += d_heading
        root_backward(self._features, _COLUMNS, self._start_heading, ground, heading, gradient)
        return gradient


@lru_cache(maxsize=16)
def _tabulate_bones(skeleton: Skeleton) -> Bones:
    """Skeletons are compared by identity."""
    # A copy: sent to another process, a tensor moves to shared memory, and a view of where it was would dangle.
    offsets, feet = skeleton.offsets.double().numpy().copy(), np.array(skeleton.indices(FEET))
    return Bones(np.array(skeleton.parents), offsets, feet, find_heels(skeleton).numpy())


def _contiguous_array(tensor: Tensor) -> np.ndarray:
    """Return a contiguous array, so that every kernel is compiled once."""
    return tensor.detach().contiguous().numpy()


class _World(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, features: Tensor, start: GroundPose, skeleton: Skeleton):
        ctx.poses = poses = WorldPoses.compute(features, start, skeleton)
        return poses.root_xz_world, poses.heading, poses.joints_world, poses.heels_world

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *pulled: Tensor):  # pyright: ignore[reportIncompatibleMethodOverride]
        return torch.from_numpy(ctx.poses.pull_back(*map(_contiguous_array, pulled))), None, None
