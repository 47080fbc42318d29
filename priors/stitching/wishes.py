"""What is told of a gap beside the two poses: hands, feet, hips, a trajectory, as residuals of motions between them."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from mapctl import rotations
from mapctl.inbetweening import GapQuery
from mapctl.kinematics import forward_kinematics, heading
from mapctl.numerics.gaussian import averaging_matrix
from mapctl.skeleton import CANONICAL
from priors.stitching.joining import Joined

_SIGMA_HAND, _SIGMA = 0.1, 0.02
"""Metres of a hand, and of a foot, the hips or a trajectory: what bends away without the rest of the body. Arms bend by
themselves: with less for hands the rest of the body comes farther from mocap that they were taken from."""
_HANDS = CANONICAL.indices(("leftHand", "rightHand"))
_FACING_ARM = 0.3  # metres by which a radian counts of how the hips face
_SWAY_FRAMES = 6.0  # frames at PRIOR_FPS, sigma, of the average in which the hips follow a trajectory
_TRAJECTORY_STRIDE = 6  # frames from one residual of a trajectory to the next


@dataclass(frozen=True, eq=False)
class Wishes:
    """Wishes about the frames of one gap, on the canonical skeleton, seen from the pose before it."""

    places: Float[Tensor, "frames joints 3"]
    """Positions that joints are to have, metres."""
    wanted: Bool[Tensor, "frames joints"]
    """Whether a joint is to have one."""
    facing: Float[Tensor, " faced"]
    """Headings that the hips are to have, radians."""
    faced: Int[Tensor, " faced"]
    """Frames in which they are to have them."""
    trajectory: Float[Tensor, "frames 2"] | None
    """Ground positions that the hips are to follow, metres; they may sway about them."""

    @staticmethod
    def of(query: GapQuery, start: int, stop: int) -> "Wishes | None":
        """See what a query tells between frames that are known on both sides; None where that is nothing."""
        hips, targets = query.root_only_keys[start:stop], query.effector_targets
        body, part = query.to_unit_size(query.motion), slice(start, stop)
        facing = heading(body.local_quat_xyzw[start - 1, 0])
        origin = body.root_position[start - 1] * torch.tensor([1.0, 0.0, 1.0]).double()

        def see(positions: Tensor) -> Tensor:
            return rotations.rotate_about_y(positions - origin, -facing.expand(positions.shape[:-1]))

        places = torch.zeros(stop - start, CANONICAL.num_joints, 3)
        wanted = torch.zeros(places.shape[:2], dtype=torch.bool)
        root = see(body.root_position[part]).float()
        if targets is not None:
            places, wanted = see(targets.places[part] / query.scale).float(), targets.wanted[part].clone()
        places[:, 0], wanted[:, 0] = root, hips
        turned = rotations.wrap_angle(heading(body.local_quat_xyzw[part, 0]) - facing).float()
        if not query.keep_trajectory and not bool(wanted.any()):
            return None
        faced = hips.nonzero()[:, 0]
        return Wishes(places, wanted, turned[faced], faced, root[:, ::2] if query.keep_trajectory else None)

    def measure(self, joined: Joined) -> Float[Tensor, "batch residuals"]:
        """Measure by how much motions miss each wish along each axis, in standard deviations."""
        return self._measure(joined) / self._sigma(joined)

    def _sigma(self, joined: Joined) -> Float[Tensor, " residuals"]:
        """Standard deviations of the residuals, metres."""
        joints = self.wanted.nonzero()[:, 1]
        hands = torch.isin(joints, torch.tensor(_HANDS))
        spatial = torch.where(hands, _SIGMA_HAND, _SIGMA).repeat_interleave(3)
        rest = self._measure(joined).shape[1] - len(spatial)
        return torch.cat([spatial, torch.full((rest,), _SIGMA)])

    def _measure(self, joined: Joined) -> Float[Tensor, "batch residuals"]:
        """Measure by how much motions miss each wish along each axis, metres."""
        positions, _ = forward_kinematics(
            CANONICAL.offsets.to(joined.root_position), CANONICAL.parents, joined.root_position, joined.quats
        )
        found = [(positions - self.places)[:, self.wanted].flatten(1)]
        turned = heading(joined.quats[:, self.faced, 0])
        found.append(_FACING_ARM * rotations.wrap_angle(turned - self.facing))
        if self.trajectory is not None:
            off = self._follow(joined.root_position)
            found.append(off[:, _TRAJECTORY_STRIDE // 2 :: _TRAJECTORY_STRIDE].flatten(1))
        return torch.cat(found, dim=1)

    def measure_farthest(self, joined: Joined) -> float:
        """Measure the largest distance of one motion to a wish, metres."""
        row, parts = self._measure(joined)[0], [torch.zeros(1)]
        spatial = 3 * int(self.wanted.sum())
        parts.append(row[:spatial].reshape(-1, 3).norm(dim=-1))
        parts.append(row[spatial : spatial + len(self.faced)].abs())
        parts.append(row[spatial + len(self.faced) :].reshape(-1, 2).norm(dim=-1))
        return float(torch.cat(parts).max())

    def lay_along(self, joined: Joined) -> Joined:
        """Move motions along the trajectory, if there is one."""
        if self.trajectory is None:
            return joined
        off = torch.nn.functional.pad(self._follow(joined.root_position), (0, 0, 1, 1))
        share = torch.linspace(0, 1, off.shape[1])[:, None]
        root = joined.root_position - rotations.lift_ground(off - torch.lerp(off[:, :1], off[:, -1:], share))[:, 1:-1]
        return Joined(root, joined.quats, joined.contacts, joined.apart)

    def _follow(self, root: Float[Tensor, "batch frames 3"]) -> Float[Tensor, "batch frames 2"]:
        """Measure how far the hips, averaged over their sway, are off the trajectory: by nothing where the gap begins
        and ends."""
        assert self.trajectory is not None
        off = torch.nn.functional.pad(root[..., ::2] - self.trajectory, (0, 0, 1, 1))
        return (averaging_matrix(off.shape[1], _SWAY_FRAMES, off.dtype) @ off)[:, 1:-1]
