"""The hips' trajectory: the body seen from its hips, and steps that lead from frame to frame.

A predicted trajectory of the hips, led through the positions that are known.

What the prediction misses the next known position by is spread in proportion to the distance walked: a standing
character does not slide, and a walking one takes steps that are a little longer, shorter or aside.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mapctl import rotations
from mapctl.features import GroundPose, integrate_steps
from mapctl.inbetweening.effector_targets import LooseKeys
from mapctl.inbetweening.position_image import mirror_positions
from mapctl.numerics.intervals import true_intervals

TREMBLE_HZ = 7.0
"""Frequency of which half is left in a predicted trajectory: hips that follow from how toes move tremble with these."""


@dataclass(frozen=True, eq=False)
class LocalMotion:
    """A batch of motions of canonical joints at the prior's rate and of unit size, without where they go."""

    positions: Float[Tensor, "batch frames joints 3"]
    """Joint positions from the hips in the hips' own heading frame, metres."""
    turns: Float[Tensor, "batch frames"]
    """Change of the heading since the frame before, radians; 0 in the first."""

    @staticmethod
    def of_world(
        positions_world: Float[Tensor, "batch frames joints 3"], heading: Float[Tensor, "batch frames"]
    ) -> "LocalMotion":
        """Take out where the hips are (world, metres) and whither they face (radians)."""
        relative = positions_world - positions_world[..., :1, :]
        turns = rotations.wrap_angle(torch.diff(heading, dim=-1, prepend=heading[..., :1]))
        return LocalMotion(rotations.rotate_about_y(relative, -heading[..., None]), turns)

    def anchored_steps(self) -> Float[Tensor, "batch frames joints 3"]:
        """Return for every joint the step of the hips that would keep it in its place, in the heading frame of the
        frame before, metres; 0 in the first frame."""
        before = torch.cat([self.positions[:, :1], self.positions[:, :-1]], dim=1)
        return before - rotations.rotate_about_y(self.positions, self.turns[..., None])

    def mirrored(self) -> "LocalMotion":
        """Exchange left and right."""
        return LocalMotion(mirror_positions(self.positions), -self.turns)


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


_LEAST_STEP = 1e-4  # metres a frame that even a body which does not move counts as walking


def close_path(
    predicted: Float[Tensor, "frames 3"], known: Float[Tensor, "frames 3"], lost: Bool[Tensor, " frames"]
) -> Float[Tensor, "frames 3"]:
    """Return the known positions (metres, Y up), and where they are lost the predicted steps from the last known one,
    led to the next; before the first known one they are followed backwards. Without any known one the prediction
    stays as it is.

    Heights are predicted by themselves and not by steps: what they are off by at a known frame fades linearly to what
    they are off by at the next.
    """
    path = known.clone()
    steps = torch.diff(predicted[:, ::2], dim=0, prepend=predicted[:1, ::2])
    walked = torch.cumsum(steps.norm(dim=-1) + _LEAST_STEP, dim=0)
    frame = torch.arange(len(predicted)).to(predicted)
    for _, start, stop in true_intervals(lost[:, None]):
        edges = [edge for edge in (start - 1, stop) if 0 <= edge < len(predicted)]
        if not edges:
            return predicted
        miss = (known - predicted)[edges]
        for axes, clock in (((0, 2), walked), ((1,), frame)):
            first, last = clock[edges[0]], clock[edges[-1]]
            share = ((clock[start:stop] - first) / (last - first).clamp_min(1e-12)).clamp(0, 1)
            offset = torch.lerp(miss[0, list(axes)], miss[-1, list(axes)], share[:, None])
            path[start:stop, list(axes)] = predicted[start:stop, list(axes)] + offset
    return path


def lead_over_keys(
    predicted: Float[Tensor, "frames 3"],
    known: Float[Tensor, "frames 3"],
    lost: Bool[Tensor, " frames"],
    loose: LooseKeys | None,
) -> Float[Tensor, "frames 3"]:
    """Close a path as `close_path` does, over positions of loose keys too, which have no height."""
    path = close_path(predicted, known, lost)
    if loose is None or not bool(loose.placed.any()):
        return path
    given = torch.stack([loose.ground[:, 0], predicted[:, 1], loose.ground[:, 1]], dim=-1).to(known)
    placed = lost & loose.placed
    ground = close_path(predicted, torch.where(placed[:, None], given, known), lost & ~placed)
    return torch.stack([ground[:, 0], path[:, 1], ground[:, 2]], dim=-1)


def compute_displacement_errors(
    predicted_xz: Float[Tensor, "*batch frames 2"], true_xz: Float[Tensor, "*batch frames 2"], span: int
) -> Float[Tensor, "*batch spans"]:
    """Compute for every frame how far the predicted displacement from it over `span` frames is from the true one,
    metres; nothing where there are not as many frames.

    Smooth at 0, so that it may be minimised: under 0.1 mm it is not exact.
    """
    apart = predicted_xz - true_xz
    return (apart[..., span:, :] - apart[..., :-span, :]).square().sum(dim=-1).add(1e-8).sqrt()
