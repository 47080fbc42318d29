"""Critics of a stitcher (Ren et al. 2024, Eq. 8 and 9): they join its training late, and hear each side by itself."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mapctl.kinematics.joint_places import place_joints
from mapctl.skeleton import CANONICAL
from priors.stitching.sides import Ends, Sides
from priors.training.adversaries.sliding_windows import (
    SHORT,
    SlidingCritics,
    compute_critic_loss,
    compute_generator_loss,
    compute_slope,
    show,
)
from priors.training.augmentation.transition_windows import Transition
from priors.training.trainer import Trainer, draw_weights, make_divergence_error

_UNTOLD = {"total": torch.ones(()), "critic": torch.ones(()), "told": torch.full((), 0.5)}
"""Of a process that was shown nothing."""


@dataclass(frozen=True)
class CriticSettings:
    """When the critics join, and how they learn."""

    begin: float = 0.7
    """Share of the updates after which they join."""

    rate: float = 2e-4
    """Their learning rate."""
    head_start: int = 100
    """Updates of theirs before the stitcher hears them; over as many again it hears more and more of them."""
    penalty: float = 0.05
    """Weight of their squared slope at captured motion."""
    noise: float = 0.1
    """Spread of what is added to all that they see."""

    def ramp(self, updates: int) -> float:
        """Return the share of their weight, so many updates after they joined."""
        return min(1.0, max(0.0, updates / self.head_start - 1)) if self.head_start else 1.0


class StitcherCritics:
    """Both critics, their optimiser, and what they have been shown since their last update."""

    def __init__(self, settings: CriticSettings, seed: int, generator: torch.Generator):
        self.settings, self.generator = settings, generator
        self.network = draw_weights(SlidingCritics, seed).to(torch.get_default_device())
        self.optimiser = torch.optim.Adam(self.network.parameters(), lr=settings.rate, betas=(0.5, 0.9))
        self.made: Tensor | None = None

    def hear(self, sides: Sides, ends: Ends, rows: Bool[Tensor, " batch"]) -> Tensor:
        """Return what the stitcher wants to make smaller (Eq. 8), and keep what it made for the next update."""
        shown = show_sides(sides, ends)[:, rows].flatten(0, 1)
        if shown.shape[1] < SHORT or not len(shown):
            self.made = None
            return shown.new_zeros(())
        self.made = shown.detach()
        return compute_generator_loss(self.network(self._blur(shown)))

    def learn(self, truth: Transition, trainer: Trainer[Any]) -> Mapping[str, float]:
        """Take one update on the captured transitions and what was made of their ends; the loss (1 where nothing is
        known), and the share of windows told apart. Nothing is learnt of what was too short to be shown."""
        (shown,) = trainer.group.agree(self.made is not None)
        if not shown:
            return {}
        self.optimiser.zero_grad(set_to_none=True)
        total, told = self._compare(truth) if self.made is not None else (None, _UNTOLD)
        self.made = None
        means = trainer.differentiate(total, self.network.parameters(), told)
        if not math.isfinite(means["total"]):
            raise make_divergence_error(trainer.step, f"the loss of the critics is {means['total']}")
        self.optimiser.step()
        return {name: means[name] for name in ("critic", "told")}

    def _compare(self, truth: Transition) -> tuple[Tensor, dict[str, Tensor]]:
        """The loss to differentiate, and the numbers to tell."""
        assert self.made is not None
        real, made = show_truth(truth, self.made.shape[1]), self.made
        for_real, for_made = self.network(self._blur(real)), self.network(self._blur(made))
        loss = compute_critic_loss(for_real, for_made)
        total = loss + self.settings.penalty * compute_slope(self.network, real)
        right = [torch.cat([one > 0.5, other < 0.5]) for one, other in zip(for_real, for_made, strict=True)]
        told = torch.stack([each.float().mean() for each in right]).mean()
        return total, {"total": total, "critic": loss, "told": told}

    def _blur(self, rows: Tensor) -> Tensor:
        return rows + self.settings.noise * torch.randn(rows.shape, generator=self.generator)


def show_sides(sides: Sides, ends: Ends) -> Float[Tensor, "sides batch made rows"]:
    """Show the critics what each side made, after its end, as time goes."""
    count = len(sides.features)
    zero = torch.zeros_like(ends.place)
    at = torch.stack([zero, ends.place])[:count, :, None]
    facing = torch.stack([zero[:, 0], ends.turn])[:count, :, None]
    end = [each.flatten(0, 1).contiguous() for each in (ends.features[:count, :, -1:], at, facing)]
    first = place_joints(end[0], end[1], end[2], CANONICAL).unflatten(0, at.shape[:2])
    walked = (
        torch.cat([first, sides.place_joints()], dim=2),
        torch.cat([at, sides.place], dim=2),
        torch.cat([facing, sides.heading], dim=2),
    )
    rows = [
        show(*(each[0] for each in walked)),
        *(show(*(each[1].flip(1) for each in walked)) for _ in range(count - 1)),
    ]
    return torch.stack(rows)


def show_truth(truth: Transition, made: int) -> Float[Tensor, "sides_times_batch made rows"]:
    """Show them what was captured: as many frames from each end on as a side makes."""
    features = truth.features[:, truth.lead : truth.lead + truth.frames + 1]
    ground, heading = truth.integrate()
    hips = torch.cat([torch.zeros_like(ground[:, :1]), ground], dim=1)
    facing = torch.cat([torch.zeros_like(heading[:, :1]), heading], dim=1)
    places = place_joints(features, hips, facing, CANONICAL)
    rows = show(places, hips, facing)
    return torch.cat([rows[:, :made], rows[:, -made:]])
