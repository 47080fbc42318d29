"""Critics of short and long sliding windows (Ren et al. 2024, section 3.4, Eq. 8 and 9, after Harvey et al. 2020).

Departures from the printed critics: least squares are joined by a penalty on the critics' slope at captured motion (R1
of Mescheder et al. 2018) and by noise on all that they see, without which they win within some hundred updates; layers
of 256 and 128, not 512 and 256.
"""

from itertools import pairwise

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.functional import leaky_relu

from mapctl import rotations
from mapctl.skeleton import CANONICAL, TOE_JOINTS

SHORT, LONG = 2, 10
"""Frames of the windows."""
_LAYERS = (256, 128, 1)
_PLACE_UNIT, _STEP_UNIT = 0.2, 0.03  # metres, and metres a frame
_SLOW = 0.05 / 30  # metres a frame under which toes' sliding is magnified
_ROWS = 6 * CANONICAL.num_joints + 2 * len(TOE_JOINTS)


class WindowCritic(nn.Module):
    """Tells captured motion from made, by windows of some frames."""

    def __init__(self, frames: int):
        super().__init__()
        self.frames = frames
        self.layers = nn.ModuleList(nn.Linear(one, other) for one, other in pairwise((frames * _ROWS, *_LAYERS)))

    def forward(self, rows: Float[Tensor, "batch frames rows"]) -> Float[Tensor, "batch windows"]:
        """Score all windows of what `show` returns; there are at least `frames` frames."""
        x = rows.unfold(1, self.frames, 1).flatten(-2)
        for number, layer in enumerate(self.layers):
            x = layer(leaky_relu(x, 0.2) if number else x)
        return x[..., 0]


class SlidingCritics(nn.Module):
    """The short and the long one."""

    def __init__(self):
        super().__init__()
        self.short, self.long = WindowCritic(SHORT), WindowCritic(LONG)

    def forward(self, rows: Float[Tensor, "batch frames rows"]) -> list[Float[Tensor, "batch windows"]]:
        """Score windows, by critic; motion that is too short for the long one has no scores of it."""
        return [critic(rows) for critic in (self.short, self.long) if rows.shape[1] >= critic.frames]


def show(
    places: Float[Tensor, "batch frames joints 3"],
    hips: Float[Tensor, "batch frames 2"],
    heading: Float[Tensor, "batch frames"],
) -> Float[Tensor, "batch frames_less_one rows"]:
    """Encode motion from its second frame on in about unit size: places of joints over the ground under the `hips` and
    in their `heading`, their steps, and those of toes that hardly move magnified."""
    away = places - rotations.lift_ground(hips)[..., None, :]
    steps = torch.diff(places, dim=1)
    there, moved = (rotations.rotate_about_y(vectors, -heading[:, 1:, None]) for vectors in (away[:, 1:], steps))
    slide = moved[..., list(TOE_JOINTS), ::2]
    rows = (there / _PLACE_UNIT, moved / _STEP_UNIT, 0.5 * torch.asinh(slide / _SLOW))
    return torch.cat([row.flatten(-2) for row in rows], dim=-1)


def compute_critic_loss(real: list[Tensor], made: list[Tensor]) -> Tensor:
    """Least squares from 1 for captured motion and from 0 for made (Eq. 9), the mean over the critics."""
    losses = [(one - 1).square().mean() + other.square().mean() for one, other in zip(real, made, strict=True)]
    return torch.stack(losses).mean()


def compute_generator_loss(made: list[Tensor]) -> Tensor:
    """Least squares of made motion from 1 (Eq. 8), the mean over the critics."""
    return torch.stack([(scores - 1).square().mean() for scores in made]).mean()


def compute_slope(critics: SlidingCritics, real: Float[Tensor, "batch frames rows"]) -> Tensor:
    """Mean squared slope of the critics at captured motion (R1)."""
    rows = real.detach().requires_grad_()
    total = torch.stack([scores.mean(dim=1).sum() for scores in critics(rows)]).sum()
    (slope,) = torch.autograd.grad(total, rows, create_graph=True)
    return slope.square().flatten(1).sum(dim=1).mean()
