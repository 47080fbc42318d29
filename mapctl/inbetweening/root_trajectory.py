"""The hips' trajectory as the body tells it: the body seen from its hips, and steps that lead from frame to frame."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mapctl import rotations
from mapctl.features import GroundPose, integrate_steps
from mapctl.inbetweening.position_image import mirror_positions

TREMBLE_HZ = 7.0
"""Frequency of which half is left in a way that is told by how the body moves: so led, hips tremble with its toes."""


@dataclass(frozen=True, eq=False)
class LocalMotion:
    """A batch of motions of canonical joints at the prior's rate and of unit size, without where they go."""

    places: Float[Tensor, "batch frames joints 3"]
    """Joint positions from the hips in the hips' own heading frame, metres."""
    turns: Float[Tensor, "batch frames"]
    """Change of the heading since the frame before, radians; 0 in the first."""
    present: Bool[Tensor, "batch frames"]
    """Whether there is such a frame; others fill up a batch."""

    @staticmethod
    def of_world(
        positions_world: Float[Tensor, "batch frames joints 3"],
        heading: Float[Tensor, "batch frames"],
        present: Bool[Tensor, "batch frames"] | None = None,
    ) -> "LocalMotion":
        """Take out where the hips are (world, metres) and whither they face (radians)."""
        present = torch.ones(heading.shape, dtype=torch.bool) if present is None else present
        relative = positions_world - positions_world[..., :1, :]
        turns = rotations.wrap_angle(torch.diff(heading, dim=-1, prepend=heading[..., :1]))
        return LocalMotion(rotations.rotate_about_y(relative, -heading[..., None]), turns, present)

    def anchored_steps(self) -> Float[Tensor, "batch frames joints 3"]:
        """Return for every joint the step of the hips that would keep it in its place, in the heading frame of the
        frame before, metres; 0 in the first frame."""
        before = torch.cat([self.places[:, :1], self.places[:, :-1]], dim=1)
        return before - rotations.rotate_about_y(self.places, self.turns[..., None])

    def mirrored(self) -> "LocalMotion":
        """Exchange left and right."""
        return LocalMotion(mirror_positions(self.places), -self.turns, self.present)


@dataclass(frozen=True, eq=False)
class RootTrajectory:
    """How the hips of a batch of motions travel."""

    steps_heading: Float[Tensor, "batch frames 2"]
    """Displacement (x, z) since the frame before, in that frame's heading frame, metres."""
    height: Float[Tensor, "batch frames"]
    """Height of the hips over the ground, metres."""
    contacts: Float[Tensor, "batch frames 2"]
    """Contact logits of the left and the right toe."""

    def integrate(self, heading: Float[Tensor, "batch frames"]) -> Float[Tensor, "batch frames 3"]:
        """Sum the steps up to positions of the hips (Zhou et al. 2020, Eq. 4), metres; the first frame is over the
        origin, and its own step, which leads there, is left out. Headings in radians."""
        turns = torch.diff(heading, dim=-1)
        start = GroundPose(torch.zeros_like(self.steps_heading[..., 0, :]), heading[..., 0])
        ground, _ = integrate_steps(self.steps_heading[..., 1:, :], turns, start)
        ground = torch.cat([start.position_xz[..., None, :], ground], dim=-2)
        return torch.stack([ground[..., 0], self.height, ground[..., 1]], dim=-1)

    def mirrored(self) -> "RootTrajectory":
        """Exchange left and right."""
        flip = self.steps_heading.new_tensor([-1.0, 1.0])
        return RootTrajectory(self.steps_heading * flip, self.height, self.contacts.flip(-1))
