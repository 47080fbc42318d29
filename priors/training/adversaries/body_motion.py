"""The tweener's critic: strided convolutions over the motion of a body (Zhou et al. 2020, section 3.5 and table 5)."""

import math

import torch
from jaxtyping import Float
from torch import Tensor, nn

from mapctl.inbetweening.root_trajectory import LocalMotion, RootTrajectory
from mapctl.skeleton import CANONICAL, TOE_JOINTS
from priors.tweening.residual import ResidualConv

_JOINTS = CANONICAL.num_joints - 1
_ROWS = 9 * _JOINTS + 1 + 2 * len(TOE_JOINTS)
_PLACE_UNIT, _STEP_UNIT, _CHANGE_UNIT, _TURN_UNIT = 0.2, 0.03, 0.01, 0.05  # metres and radians, a frame (and frame)
_SLOW = 0.05 / 30  # metres a frame under which toes' sliding is magnified
WIDTHS = (96, 128, 192, 256, 256)
"""Channels of the layers, each of which halves the frames; the paper's six reach over two thirds of our clips."""
FIELD = 94
"""Frames that a score is of."""
ANSWER_REAL, ANSWER_MADE = 1.0, -1.0
"""What the critic is to answer (Eq. 7)."""
_UNDECIDED = math.sqrt(5) - 2  # what the generator wants to hear (Eq. 8)


class BodyMotionCritic(nn.Module):
    """Tells captured motion from made, by patches of FIELD frames.

    It sees places of joints, and beside the paper their steps and how these change, and toes that hardly move
    magnified: what trembles or slides is lost among places.
    """

    def __init__(self):
        super().__init__()
        channels = zip((_ROWS, *WIDTHS[:-1]), WIDTHS, strict=True)
        self.layers = nn.ModuleList(
            ResidualConv(pair, kernel=4, stride=2, padding=1, ratio=ratio)
            for ratio, pair in enumerate(channels, start=1)
        )
        self.last = nn.Conv1d(WIDTHS[-1], 1, 1)

    def forward(
        self, rows: Float[Tensor, "batch frames rows"]
    ) -> tuple[Float[Tensor, "batch patches"], tuple[Tensor, ...]]:
        """Score the patches of what `show` returns; also returns what the convolutions gave, for batch
        regularisation."""
        responses: list[Tensor] = []
        hidden = rows.transpose(1, 2)
        for layer in self.layers:
            hidden = layer(hidden, responses)
        return self.last(hidden)[:, 0], tuple(responses)


def show(motion: LocalMotion, trajectory: RootTrajectory) -> Float[Tensor, "batch frames rows"]:
    """Encode motion and the way that the path predictor tells of it in about unit size."""
    anchored = motion.anchored_steps()
    steps = anchored[..., 1:, :].flatten(-2)
    change = torch.diff(steps, dim=1, prepend=steps[:, :1])
    slide = anchored[..., list(TOE_JOINTS), ::2] - trajectory.steps_heading[..., None, :]
    rows = (
        motion.places[..., 1:, :].flatten(-2) / _PLACE_UNIT,
        steps / _STEP_UNIT,
        change / _CHANGE_UNIT,
        motion.turns[..., None] / _TURN_UNIT,
        0.5 * torch.asinh(slide / _SLOW).flatten(-2),
    )
    # The first two frames have no step, or no change of it.
    return torch.cat(rows, dim=-1)[:, 2:]


def compute_critic_loss(real: Float[Tensor, "batch patches"], made: Float[Tensor, "others others_patches"]) -> Tensor:
    """Least squares from what the critic is to answer (Eq. 7)."""
    return (real - ANSWER_REAL).square().mean() + (made - ANSWER_MADE).square().mean()


def compute_generator_loss(made: Float[Tensor, "batch patches"]) -> Tensor:
    """Least squares from what the generator wants to hear (Eq. 8)."""
    return (made - _UNDECIDED).square().mean()


def compute_gradient_penalty(critic: BodyMotionCritic, real: Float[Tensor, "batch frames rows"]) -> Tensor:
    """Mean squared slope of the critic at captured motion (R1 of Mescheder et al. 2018)."""
    rows = real.detach().requires_grad_()
    (slope,) = torch.autograd.grad(critic(rows)[0].sum(), rows, create_graph=True)
    return slope.square().flatten(1).sum(dim=1).mean()
