"""Fast root integration and forward kinematics of a trial: compiled, with hand-written adjoints, on one core.

Same mathematics as `features.integrate_root` and `kinematics.positions_from_matrices`, which remain the specification
and serve every case but float32 on the CPU. Each is one node of torch's graph, differentiable once.
"""

from dataclasses import dataclass
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.autograd.function import once_differentiable

from mapctl.features import LAYOUT, GroundPose
from mapctl.kinematics import fast_kernels
from mapctl.pose import BodyPose
from mapctl.skeleton import FEET, Skeleton, find_heels


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
    """Index of each joint's parent."""
    offsets: np.ndarray
    """(joints, 3): each joint in its parent's frame, metres, float64."""
    feet: np.ndarray
    """Indices of the left and the right foot joint."""
    heels: np.ndarray
    """(2, 3): the heels in the frames of the feet, metres, float64."""


def _find_columns() -> FeatureColumns:
    first = {block: part.start for block, part in LAYOUT.slices.items()}
    step, tilt = first["root_displacement_heading"], first["root_tilt"]
    return FeatureColumns(
        step, step + 1, first["heading_change"], first["root_height"], tilt, tilt + 1, first["joint_rotations"]
    )


_COLUMNS = _find_columns()
_JOINTS = 1 + (LAYOUT.slices["joint_rotations"].stop - LAYOUT.slices["joint_rotations"].start) // 3


def is_supported(features: Tensor, start: GroundPose, skeleton: Skeleton) -> bool:
    """Return whether the kernels support these: float32 batches on the CPU, and gradients to the features alone."""
    known = (features, start.position_xz, start.heading)
    plain = all(values.dtype == torch.float32 and values.device.type == "cpu" for values in known)
    constant = not (start.position_xz.requires_grad or start.heading.requires_grad or skeleton.offsets.requires_grad)
    shapes = (torch.Size(), torch.Size((1,)), features.shape[:1])
    fits = features.ndim == 3 and start.heading.shape in shapes and start.position_xz.shape[:-1] in shapes
    return plain and constant and fits and skeleton.num_joints == _JOINTS


def integrate_root_fast(
    features: Float[Tensor, "batch frames size"], start: GroundPose
) -> tuple[Float[Tensor, "batch frames 2"], Float[Tensor, "batch frames"]]:
    """Integrate root ground positions (metres) and headings (radians, not wrapped): Wang et al. 2019, Eq. 4."""
    batch = len(features)
    return _Root.apply(
        features, start.position_xz.expand(batch, 2).contiguous(), start.heading.expand(batch).contiguous()
    )


def compute_joints_and_heels(
    features: Float[Tensor, "batch frames size"],
    root_xz_world: Float[Tensor, "batch frames 2"],
    heading: Float[Tensor, "batch frames"],
    skeleton: Skeleton,
) -> tuple[Float[Tensor, "batch frames joints 3"], Float[Tensor, "batch frames 2 3"]]:
    """Compute the world positions of joints, and of the left and the right heel (see `skeleton.find_heels`), metres."""
    return _Body.apply(features, root_xz_world, heading, skeleton)


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
        fast_kernels.root_forward(known, _COLUMNS, at.numpy(), start_heading.numpy(), ground.numpy(), heading.numpy())
        positions, heels = _allocate_points(features, bones)
        turns = np.empty((*positions.shape, 3), np.float32)
        fast_kernels.body_forward(
            known, _COLUMNS, ground.numpy(), heading.numpy(), bones, positions.numpy(), heels.numpy(), turns
        )
        return WorldPoses(ground, heading, positions, heels, known, start_heading.numpy(), bones, turns)

    def pull_back(
        self, d_root_xz: np.ndarray, d_heading: np.ndarray, d_joints: np.ndarray, d_heels: np.ndarray
    ) -> np.ndarray:
        """Return the gradient on the features (batch, frames, size) from those on roots, headings, joints and heels."""
        gradient, (batch, frames, _) = np.zeros(self._features.shape, np.float32), self._features.shape
        ground, heading = np.empty((batch, frames, 2), np.float32), np.empty((batch, frames), np.float32)
        fast_kernels.body_backward(
            self._features, _COLUMNS, self._bones, self._rotations, d_joints, d_heels, gradient, ground, heading
        )
        ground += d_root_xz
        heading += d_heading
        fast_kernels.root_backward(self._features, _COLUMNS, self._start_heading, ground, heading, gradient)
        return gradient


@lru_cache(maxsize=16)
def _tabulate_bones(skeleton: Skeleton) -> Bones:
    """Skeletons are compared by identity."""
    # A copy: sent to another process, a tensor moves to shared memory, and a view of where it was would dangle.
    offsets, feet = skeleton.offsets.double().numpy().copy(), np.array(skeleton.indices(FEET))
    return Bones(np.array(skeleton.parents), offsets, feet, find_heels(skeleton).numpy())


def _allocate_points(features: Tensor, bones: Bones) -> tuple[Tensor, Tensor]:
    """Memory for the positions of joints and of heels."""
    joints, heels = (features.new_empty(*features.shape[:2], len(points), 3) for points in (bones.offsets, bones.heels))
    return joints, heels


def _contiguous_array(tensor: Tensor) -> np.ndarray:
    """Return a contiguous array, so that every kernel is compiled once."""
    return tensor.detach().contiguous().numpy()


class _Root(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, features: Tensor, start_xz: Tensor, start_heading: Tensor):
        ground, heading = features.new_empty(*features.shape[:2], 2), features.new_empty(features.shape[:2])
        known, at = _contiguous_array(features), start_heading.numpy()
        fast_kernels.root_forward(known, _COLUMNS, start_xz.numpy(), at, ground.numpy(), heading.numpy())
        ctx.known = known, at
        return ground, heading

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *pulled: Tensor):  # pyright: ignore[reportIncompatibleMethodOverride]
        features, start_heading = ctx.known
        gradient = np.zeros(features.shape, np.float32)
        fast_kernels.root_backward(features, _COLUMNS, start_heading, *map(_contiguous_array, pulled), gradient)
        return torch.from_numpy(gradient), None, None


class _Body(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, features: Tensor, ground: Tensor, heading: Tensor, skeleton: Skeleton):
        bones = _tabulate_bones(skeleton)
        positions, heels = _allocate_points(features, bones)
        world = np.empty((*positions.shape, 3), np.float32)
        known = _contiguous_array(features)
        fast_kernels.body_forward(
            known,
            _COLUMNS,
            _contiguous_array(ground),
            _contiguous_array(heading),
            bones,
            positions.numpy(),
            heels.numpy(),
            world,
        )
        ctx.known = known, bones, world
        return positions, heels

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *pulled: Tensor):  # pyright: ignore[reportIncompatibleMethodOverride]
        features, bones, world = ctx.known
        gradient, shape = np.zeros(features.shape, np.float32), features.shape[:2]
        ground, heading = np.empty((*shape, 2), np.float32), np.empty(shape, np.float32)
        fast_kernels.body_backward(
            features, _COLUMNS, bones, world, *map(_contiguous_array, pulled), gradient, ground, heading
        )
        return *map(torch.from_numpy, (gradient, ground, heading)), None


def place_joints(
    features: Float[Tensor, "batch frames size"],
    root_xz_world: Float[Tensor, "batch frames 2"],
    heading: Float[Tensor, "batch frames"],
    skeleton: Skeleton,
) -> Float[Tensor, "batch frames joints 3"]:
    """Place the joints of features in the world, metres, over these points of the ground, facing these headings.

    Features are of single precision; all tensors lie on one device.
    """
    if features.device.type == "cpu":
        return compute_joints_and_heels(features, root_xz_world, heading, skeleton)[0]
    return BodyPose.of_features_at(features, root_xz_world, heading).joints_world(skeleton)
