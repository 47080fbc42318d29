"""A critic of the density's free runs, which joins the last steps of training.

Moments (see moment_matching) hold each number of a free run to the data, not how they go together: a classifier still
separates such runs from mocap by poses and by the hips' trajectory. The critic judges a second of a free run, far from
the mocap that it began with; the density is made likelier to pass, beside being likely. Ours. It sees what the
classifier of `mapctl measure` does: positions and velocities in the ground frame of the first frame. Feet that hardly
move are not magnified, as for the refiner's critic: by the noise of their single frames, which a mixture draws and no
weights take away, it wins at once.
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.functional import leaky_relu, softplus

from mapctl import rotations
from mapctl.features import PRIOR_FPS
from mapctl.skeleton import CANONICAL
from mapctl.terms.trial import Trial
from priors.config import require_at_least
from priors.training.trainer import HistoryBuffer, draw_weights, make_divergence_error
from priors.training.windows import FeatureWindows

_WIDTH = 128
_LAYERS = ((3, 1), (5, 2), (5, 2), (3, 1))  # kernel and stride
_LEAST_STD = 0.01
_HIPS = CANONICAL.index("hips")
_MEASURED = 256  # captured windows by which the critic's input is standardised
_WARM_UP = 20  # steps in which the density's learning rate rises
_FALL = 0.3  # share of the steps in which it falls to nothing


@dataclass(frozen=True)
class CriticSettings:
    """When the critic joins, how it learns, and how the density does from then on."""

    steps: int = 0
    """Last steps of the run, in which it judges free runs; 0 leaves it out."""
    learning_rate: float = 3e-4
    """Of the density in these steps; it falls to nothing over the last three tenths."""
    every: int = 2
    """Steps from one free run to the next."""
    frames: int = 30
    """Frames of a run that it sees."""
    weight: float = 1.0
    """Weight of its loss, whose gradient is clipped by itself."""
    rate: float = 6e-4
    """Learning rate of the critic."""
    updates: int = 2
    """Updates of the critic in a step."""
    head_start: int = 400
    """Updates of the critic before the density is trained by it."""
    batch: int = 64
    """Windows of captured motion an update, and as many of free runs."""
    history: int = 512
    """Windows of free runs that are kept for it."""
    penalty: float = 0.5
    """Weight of its squared slope at captured motion."""
    average: float = 0.995
    """Share of the past in the running mean of the density's weights, which is what is kept."""

    def __post_init__(self):
        require_at_least(self, 0, "steps", "head_start")
        require_at_least(self, 1, "every", "updates", "batch", "history")
        require_at_least(self, 2, "frames")

    def compute_learning_rate(self, step: int, steps: int) -> float:
        """That of the density in a step of so many with the critic."""
        rise = min(1.0, (step + 1) / _WARM_UP)
        return self.learning_rate * rise * min(1.0, (steps - step) / max(1.0, _FALL * steps))


class FreeRunJudge:
    """The critic, its optimiser, and the free runs that it has been shown."""

    def __init__(self, settings: CriticSettings, windows: FeatureWindows, *, seed: int):
        """`windows` are of captured motion, and longer than what it sees."""
        self.settings, self.windows = settings, windows
        shown = self._show_captured(_MEASURED, torch.Generator(windows.features.device).manual_seed(seed))
        self.network = draw_weights(lambda: FreeRunCritic(shown.cpu()), seed).to(torch.get_default_device())
        self.optimiser = torch.optim.Adam(self.network.parameters(), lr=settings.rate, betas=(0.5, 0.99))
        self.history: HistoryBuffer | None = None

    def fill(self, made: Float[Tensor, "history frames size"]) -> None:
        """Begin to keep free runs for the critic to learn from, with these."""
        self.history = HistoryBuffer(self._show_end(made))

    def score(self, made: Float[Tensor, "batch frames size"], generator: torch.Generator) -> Tensor:
        """Return the density's loss, whose gradient goes into what generated the motion; and keep the free runs in
        place of earlier ones."""
        assert self.history is not None
        shown = self._show_end(made)
        self.history.keep(shown.detach(), generator)
        return self.settings.weight * compute_generator_loss(self.network(shown))

    def learn(self, step: int, updates: int, generator: torch.Generator) -> dict[str, float]:
        """Take updates on captured motion and what is kept; return the mean loss (1.39 where nothing is known), and the
        mean share of windows classified correctly."""
        rows = [self._update(step, generator) for _ in range(updates)]
        return {name: sum(row[name] for row in rows) / len(rows) for name in ("critic", "told")}

    def _update(self, step: int, generator: torch.Generator) -> dict[str, float]:
        assert self.history is not None
        count = self.settings.batch
        real = self._show_captured(count, generator)
        for_real, for_made = self.network(real), self.network(self.history.draw(count, generator))
        loss = compute_critic_loss(for_real, for_made)
        total = loss + self.settings.penalty * compute_gradient_penalty(self.network, real)
        self.optimiser.zero_grad(set_to_none=True)
        total.backward()
        if not math.isfinite(float(total.detach())):
            raise make_divergence_error(step, f"the loss of the critic is {float(total.detach())}")
        self.optimiser.step()
        right = torch.cat([for_real > 0, for_made < 0]).float().mean()
        return {"critic": float(loss.detach()), "told": float(right)}

    def _show_captured(self, count: int, generator: torch.Generator) -> Float[Tensor, "count seen rows"]:
        return show(self.windows.draw(count, generator).features[:, : self.settings.frames + 1])

    def _show_end(self, made: Float[Tensor, "batch frames size"]) -> Float[Tensor, "batch seen rows"]:
        """Show the last frames of free runs: they are farthest from mocap."""
        return show(made[:, -self.settings.frames - 1 :])


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
