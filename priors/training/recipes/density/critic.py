"""A critic of the density's free runs, which joins the last steps of training.

Moments (see moment_matching) hold each number of a free run to the data, not how they go together: a network still
told three of four samples from mocap by poses and by the hips' way. The critic judges a second of a free run, far from
the mocap that it began with; the density is made likelier to pass, beside being likely. Ours.
"""

import math
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from priors.config import require_at_least
from priors.training.adversaries.free_runs import (
    FreeRunCritic,
    compute_critic_loss,
    compute_generator_loss,
    compute_gradient_penalty,
    show,
)
from priors.training.adversaries.history import HistoryBuffer
from priors.training.trainer import Trainer, draw_weights, make_divergence_error
from priors.training.windows import FeatureWindows

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
    """Weight of what it says; its gradient is clipped by itself."""
    rate: float = 6e-4
    """Learning rate of the critic."""
    updates: int = 2
    """Updates of the critic in a step."""
    head_start: int = 400
    """Updates of the critic before the density hears it."""
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

    def __init__(self, settings: CriticSettings, windows: FeatureWindows, *, mirror: bool, seed: int):
        """`windows` are of captured motion, and longer than what it sees."""
        self.settings, self.windows, self.mirror = settings, windows, mirror
        shown = self._show_captured(_MEASURED, torch.Generator(windows.features.device).manual_seed(seed))
        self.network = draw_weights(lambda: FreeRunCritic(shown.cpu()), seed).to(torch.get_default_device())
        self.optimiser = torch.optim.Adam(self.network.parameters(), lr=settings.rate, betas=(0.5, 0.99))
        self.history: HistoryBuffer | None = None

    def fill(self, made: Float[Tensor, "history frames size"]) -> None:
        """Begin to keep free runs for the critic to learn from, with these."""
        self.history = HistoryBuffer(self._show_end(made))

    def hear(self, made: Float[Tensor, "batch frames size"], generator: torch.Generator) -> Tensor:
        """Return what the density wants to make smaller, whose gradient goes into what made the motion; and keep the
        free runs in the place of earlier ones."""
        assert self.history is not None
        shown = self._show_end(made)
        self.history.keep(shown.detach(), generator)
        return self.settings.weight * compute_generator_loss(self.network(shown))

    def learn(self, trainer: Trainer[Any], updates: int) -> dict[str, float]:
        """Take updates on captured motion and what is kept; the mean loss (1.39 where nothing is known), and the mean
        share of windows told apart."""
        rows = [self._update(trainer) for _ in range(updates)]
        return {name: sum(row[name] for row in rows) / len(rows) for name in ("critic", "told")}

    def _update(self, trainer: Trainer[Any]) -> dict[str, float]:
        assert self.history is not None
        count, generator = trainer.group.share(self.settings.batch), trainer.generator
        real = self._show_captured(count, generator)
        for_real, for_made = self.network(real), self.network(self.history.draw(count, generator))
        loss = compute_critic_loss(for_real, for_made)
        total = loss + self.settings.penalty * compute_gradient_penalty(self.network, real)
        self.optimiser.zero_grad(set_to_none=True)
        right = torch.cat([for_real > 0, for_made < 0]).float().mean()
        told = {"total": total, "critic": loss, "told": right}
        means = trainer.differentiate(total, self.network.parameters(), told)
        if not math.isfinite(means["total"]):
            raise make_divergence_error(trainer.step, f"the loss of the critic is {means['total']}")
        self.optimiser.step()
        return means

    def _show_captured(self, count: int, generator: torch.Generator) -> Float[Tensor, "count seen rows"]:
        return show(self.windows.draw(count, generator, mirror=self.mirror).features[:, : self.settings.frames + 1])

    def _show_end(self, made: Float[Tensor, "batch frames size"]) -> Float[Tensor, "batch seen rows"]:
        """Show the last frames of free runs: they are farthest from mocap."""
        return show(made[:, -self.settings.frames - 1 :])
