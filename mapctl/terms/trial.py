"""One candidate motion as the terms see it: built once per evaluation, world poses computed at most once."""

from dataclasses import dataclass, field
from functools import cached_property

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mapctl import kinematics, rotations
from mapctl.features import LAYOUT, GroundPose, integrate_root
from mapctl.kinematics import fast
from mapctl.skeleton import CANONICAL, Skeleton


@dataclass(frozen=True, eq=False)
class Trial:
    """A batch of candidate windows, canonical joints, float32 or float64."""

    features: Float[Tensor, "batch frames size"]
    """Physical units."""
    start: GroundPose
    """Where the frame before the window stands; unbatched or with the batch's shape."""
    noise: Float[Tensor, "batch frames continuous"]
    """The random numbers the candidate was made with: latents of a rollout, or noise on the network's input."""
    log_density: Float[Tensor, "batch frames"]
    """Nats of each frame given those before it, under the prior."""
    contacts: Bool[Tensor, "batch frames 2"]
    """Left and right toe planted, by the prior's own bits; fixed during a solve."""
    before: Float[Tensor, "past joints 3"]
    """World joint positions of the last frames before the window, metres, oldest first; the same for all."""
    skeleton: Skeleton = CANONICAL
    """Whose bones forward kinematics uses."""
    fps: float = 30.0
    """Frames per second."""
    contacts_before: Bool[Tensor, "*batch 2"] = field(default_factory=lambda: torch.zeros(2, dtype=torch.bool))
    """Left and right toe planted in the frame before the window; unbatched or with the batch's shape."""

    @cached_property
    def _use_kernels(self) -> bool:
        return fast.is_supported(self.features, self.start, self.skeleton)

    @cached_property
    def _root(self) -> tuple[Tensor, Tensor]:
        places = fast.integrate_root_fast if self._use_kernels else integrate_root
        return places(self.features, self.start)

    @property
    def root_xz_world(self) -> Float[Tensor, "batch frames 2"]:
        """Ground projection of the hips, metres."""
        return self._root[0]

    @property
    def heading(self) -> Float[Tensor, "batch frames"]:
        """Facing angle about +Y, radians, not wrapped."""
        return self._root[1]

    @cached_property
    def joints_world(self) -> Float[Tensor, "batch frames joints 3"]:
        """World joint positions, metres, by forward kinematics of the whole body."""
        if self._use_kernels:
            return fast.compute_joints_world(self.features, self.root_xz_world, self.heading, self.skeleton)
        tilt_xz = LAYOUT.pick(self.features, "root_tilt")
        tilt = torch.stack([tilt_xz[..., 0], torch.zeros_like(self.heading), tilt_xz[..., 1]], dim=-1)
        vectors = torch.cat([tilt, LAYOUT.pick(self.features, "joint_rotations")], dim=-1).unflatten(-1, (-1, 3))
        turn = heading_matrix(self.heading)
        matrices = rotations.rotation_vector_to_matrix(vectors)
        root = torch.stack(
            [self.root_xz_world[..., 0], LAYOUT.pick(self.features, "root_height")[..., 0], self.root_xz_world[..., 1]],
            dim=-1,
        )
        relative = kinematics.positions_from_matrices(self.skeleton, matrices)
        return root.unsqueeze(-2) + relative @ turn.transpose(-1, -2)

    def joint_world(self, name: str) -> Float[Tensor, "batch frames 3"]:
        """World positions of one joint, metres."""
        return self.joints_world[..., self.skeleton.index(name), :]

    def step(self, joint: int) -> Float[Tensor, "batch frames 3"]:
        """Displacement of a joint since the frame before, metres; the first frame's needs a past, or is 0."""
        places = self.joints_world[..., joint, :]
        past = self.before[-1:, joint].to(places.dtype) if len(self.before) else places[:, :1].detach()
        return torch.diff(places, dim=-2, prepend=past.expand(len(places), 1, 3))


def heading_matrix(heading: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch 3 3"]:
    """Rotation matrices of turns about +Y."""
    sine, cosine, zero, one = (
        torch.sin(heading),
        torch.cos(heading),
        torch.zeros_like(heading),
        torch.ones_like(heading),
    )
    rows = torch.stack([cosine, zero, sine, zero, one, zero, -sine, zero, cosine], dim=-1)
    return rows.unflatten(-1, (3, 3))
