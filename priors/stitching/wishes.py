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
_SWAY_FRAMES = 5.0  # frames at PRIOR_FPS, sigma, of the average in which the hips follow a trajectory
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
        part, targets = slice(start, stop), query.effector_targets
        hips = query.root_only_keys[part]
        told = query.keep_trajectory or bool(hips.any()) or (targets is not None and bool(targets.wanted[part].any()))
        if not told:
            return None
        body = query.to_unit_size(query.motion)
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
        faced = hips.nonzero()[:, 0]
        return Wishes(places, wanted, turned[faced], faced, root[:, ::2] if query.keep_trajectory else None)

    def measure(self, joined: Joined) -> Float[Tensor, "batch residuals"]:
        """Measure by how much motions miss each wish along each axis, in standard deviations."""
        places, facing, trajectory = self._measure(joined)
        hands = torch.isin(self.wanted.nonzero()[:, 1], torch.tensor(_HANDS))
        sigma = torch.where(hands, _SIGMA_HAND, _SIGMA)[:, None]
        parts = (places / sigma, facing / _SIGMA, trajectory / _SIGMA)
        return torch.cat([part.flatten(1) for part in parts], dim=1)

    def measure_farthest(self, joined: Joined) -> float:
        """Measure the largest distance of one motion to a wish, metres."""
        return max((float(part[0].norm(dim=-1).max()) for part in self._measure(joined) if part.numel()), default=0.0)

    def lay_along(self, joined: Joined) -> Joined:
        """Move motions along the trajectory, if there is one."""
        if self.trajectory is None:
            return joined
        root = joined.root_position - rotations.lift_ground(self._follow(joined.root_position, self.trajectory))
        return Joined(root, joined.quats, joined.contacts, joined.apart)

    def _measure(
        self, joined: Joined
    ) -> tuple[Float[Tensor, "batch places 3"], Float[Tensor, "batch faced 1"], Float[Tensor, "batch points 2"]]:
        """Measure by how much motions miss places, headings and points of the trajectory, metres."""
        root = joined.root_position
        positions, _ = forward_kinematics(CANONICAL.offsets.to(root), CANONICAL.parents, root, joined.quats)
        turned = rotations.wrap_angle(heading(joined.quats[:, self.faced, 0]) - self.facing)
        off = root[:, :0, ::2] if self.trajectory is None else self._follow(root, self.trajectory)
        points = off[:, _TRAJECTORY_STRIDE // 2 :: _TRAJECTORY_STRIDE]
        return (positions - self.places)[:, self.wanted], _FACING_ARM * turned[..., None], points

    @staticmethod
    def _follow(
        root: Float[Tensor, "batch frames 3"], trajectory: Float[Tensor, "frames 2"]
    ) -> Float[Tensor, "batch frames 2"]:
        """Measure how far the hips, averaged over their sway, are off the trajectory: by nothing in the frames before
        and after, which are known."""
        off = torch.nn.functional.pad(root[..., ::2] - trajectory, (0, 0, 1, 1))
        # Beyond the known frames it goes on turned round, so that its average there is nothing, too.
        turned, count = -off[:, 1:-1].flip(1), len(trajectory)
        whole = torch.cat([turned, off, turned], dim=1)
        return averaging_matrix(whole.shape[1], _SWAY_FRAMES, off.dtype)[count + 1 : 2 * count + 1] @ whole
