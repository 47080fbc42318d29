"""The density's critic: convolutions over a second of a body's motion, seen from where it began.

Ours. It sees what the network by which `mapctl measure` tells made motion from mocap does: positions and velocities in
the ground frame of the first frame. Feet that hardly move are not
magnified, as for other critics: by the noise of their single frames, which a mixture draws and no weights take away, it
wins at once.
"""

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.functional import leaky_relu, softplus

from mapctl import rotations
from mapctl.features import PRIOR_FPS
from mapctl.skeleton import CANONICAL
from mapctl.terms.trial import Trial

_WIDTH = 128
_LAYERS = ((3, 1), (5, 2), (5, 2), (3, 1))  # kernel and stride
_LEAST_STD = 0.01
_HIPS = CANONICAL.index("hips")


class FreeRunCritic(nn.Module):
    """Tells captured motion from free runs."""

    mean: Tensor
    std: Tensor

    def __init__(self, rows: Float[Tensor, "windows frames rows"]):
        """`rows` are captured, as `show` returns them; what it sees is measured in their standard deviations."""
        super().__init__()
        self.register_buffer("mean", rows.mean((0, 1)))
        self.register_buffer("std", rows.std((0, 1)).clamp_min(_LEAST_STD))
        widths = (rows.shape[-1], *(_WIDTH,) * (len(_LAYERS) - 1))
        self.layers = nn.ModuleList(
            nn.Conv1d(seen, _WIDTH, kernel, stride, padding=kernel // 2)
            for seen, (kernel, stride) in zip(widths, _LAYERS, strict=True)
        )
        self.last = nn.Linear(2 * _WIDTH, 1)

    def standardise(self, rows: Float[Tensor, "batch frames rows"]) -> Float[Tensor, "batch frames rows"]:
        """Put rows into the units that `judge` takes."""
        return (rows - self.mean) / self.std

    def judge(self, standard: Float[Tensor, "batch frames rows"]) -> Float[Tensor, " batch"]:
        """Return the logits that windows were captured; by the mean over time and by the worst moment."""
        hidden = standard.transpose(1, 2)
        for layer in self.layers:
            hidden = leaky_relu(layer(hidden), 0.2)
        return self.last(torch.cat([hidden.mean(-1), hidden.amax(-1)], -1))[:, 0]

    def forward(self, rows: Float[Tensor, "batch frames rows"]) -> Float[Tensor, " batch"]:
        """Return the logits that windows of what `show` returns were captured."""
        return self.judge(self.standardise(rows))


def show(features: Float[Tensor, "batch frames size"]) -> Float[Tensor, "batch frames_less_one rows"]:
    """Encode motion from its second frame on, in metres and m/s on the ground frame of the first: joints about the
    hips, all joints' velocities, and the hips."""
    trial = Trial.of_features(features)
    first = rotations.lift_ground(trial.joints_world[:, :1, _HIPS, ::2]).unsqueeze(-2)
    seen = rotations.rotate_about_y(trial.joints_world - first, -trial.heading[:, :1, None])
    hips, velocity = seen[:, 1:, _HIPS], torch.diff(seen, dim=1) * PRIOR_FPS
    about = seen[:, 1:] - rotations.lift_ground(hips[..., ::2]).unsqueeze(-2)
    return torch.cat([about.flatten(2), velocity.flatten(2), hips], dim=-1)


def compute_critic_loss(real: Float[Tensor, " batch"], made: Float[Tensor, " others"]) -> Tensor:
    """Cross entropy of both answers in nats; 1.39 where nothing is known (Goodfellow et al. 2014, Eq. 1)."""
    return softplus(-real).mean() + softplus(made).mean()


def compute_generator_loss(made: Float[Tensor, " batch"]) -> Tensor:
    """Negative log probability that what was made is taken for captured (Goodfellow et al. 2014, section 3)."""
    return softplus(-made).mean()


def compute_gradient_penalty(critic: FreeRunCritic, real: Float[Tensor, "batch frames rows"]) -> Tensor:
    """Mean squared slope of the critic at captured motion (R1 of Mescheder et al. 2018), by standard deviations."""
    standard = critic.standardise(real).detach().requires_grad_()
    (slope,) = torch.autograd.grad(critic.judge(standard).sum(), standard, create_graph=True)
    return slope.square().flatten(1).sum(dim=1).mean()
