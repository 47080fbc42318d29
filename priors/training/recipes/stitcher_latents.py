"""Latents with which a stitcher is taught: told by who has seen the truth, at the mean, and drawn."""

from dataclasses import dataclass, field

import torch
from jaxtyping import Float
from torch import Tensor

from priors.stitching.latents import DrawnLatents
from priors.stitching.network import SEEN_FUTURE, Gaussian, StitcherNetwork
from priors.stitching.posterior import PosteriorNetwork
from priors.stitching.sides import count_made, walk_sides
from priors.training.augmentation.transition_windows import Transition

TRIES = 4
"""Draws of which the nearest is taught."""


@dataclass(eq=False)
class TaughtLatents:
    """The posterior's latents, which has seen the truth, in the first rows of a batch, and what noise becomes in the
    rest."""

    posterior: PosteriorNetwork
    """Sees the truth."""
    truth: Float[Tensor, "2 batch frames size"]
    """Normalised features from each end's next frame to the other end."""
    missed: Float[Tensor, "2 informed made size"]
    """What the calm answer misses of it, in the first rows, which are given the posterior's."""
    noise: DrawnLatents
    """Of all rows; zeros at the mean."""
    nats: list[Tensor] = field(default_factory=list)
    """Divergences from the prior by row and dimension, the transition's first and then those of frames."""
    cost: Tensor = field(default_factory=lambda: torch.zeros(()))
    """The transition's divergence from a standard normal distribution, by row and dimension."""

    def share(self, prior: Gaussian, seen: Float[Tensor, "2 batch seen"]) -> Float[Tensor, "batch shared"]:
        """What both sides share over the transition."""
        count = self.missed.shape[1]
        if not count:
            self.nats.append(self.noise.shared[:0])
            return self.noise.share(prior, seen)
        told = self.posterior.tell_shared(self.missed)
        self.cost = told.diverge(Gaussian(torch.zeros_like(told.mean), torch.zeros_like(told.mean)))
        # Held to a prior that sees the ends, the posterior would learn to tell nothing but these.
        self.nats.append(told.detach().diverge(prior.row(slice(count))))
        noise = self.noise.shared
        return torch.cat([told.draw(noise[:count]), prior.row(slice(count, None)).draw(noise[count:])])

    def own(self, prior: Gaussian, encoded: Float[Tensor, "2 batch width"], step: int) -> Float[Tensor, "2 batch own"]:
        """A frame's, of both sides."""
        last = self.truth.shape[2] - 1
        ahead = [min(step + number, last) for number in range(SEEN_FUTURE)]
        told = self.posterior.tell_own(self.truth[:, :, ahead], encoded)
        self.nats.append(told.diverge(prior).mean(dim=0))
        noise = self.noise.slow[:, :, step]
        informed = torch.arange(noise.shape[1]) < self.missed.shape[1]
        return torch.where(informed[:, None], told.draw(noise), prior.draw(noise))

    def diverge(self) -> dict[str, Tensor]:
        """Return the divergences that are learnt, nats a transition, by the names of their weights."""
        count = self.missed.shape[1]
        if not count:
            return {name: torch.zeros(()) for name in ("shared", "prior", "own")}
        shared, frames = self.nats[0], torch.stack(self.nats[1:]).sum(dim=0)
        prior, own = (each[:count].mean(dim=0).sum() for each in (shared, frames))
        return {"shared": self.cost.mean(dim=0).sum(), "prior": prior, "own": own}


@torch.no_grad()
def miss_calmly(network: StitcherNetwork, truth: Transition) -> Float[Tensor, "2 batch made size"]:
    """Return what the calm answer to the ends of transitions misses of the truth, in units of the features' spread."""
    count, made = len(truth.features), count_made(network, truth.frames)
    if not count:
        return network.mean.new_zeros(2, 0, made, len(network.mean))
    calm = DrawnLatents.calm(network.config, count, made)
    found = walk_sides(network, truth.ends(), truth.frames, calm).features
    return (truth.truth()[:, :, :made] - found) / network.std


@torch.no_grad()
def sample_nearest(network: StitcherNetwork, truth: Transition, generator: torch.Generator) -> DrawnLatents:
    """Sample several latents for each of some transitions, and return those whose answers have joints nearest to the
    truth."""
    count, made = len(truth.features), count_made(network, truth.frames)
    tries = TRIES if count else 0
    every = torch.arange(count).repeat(tries)
    noise = DrawnLatents.sample(network.config, len(every), made, generator)
    if not tries:
        return noise
    repeated = truth.rows(every)
    sides = walk_sides(network, repeated.ends(), truth.frames, noise)
    away = (sides.place_joints() - repeated.place_joints(made)).norm(dim=-1)
    best = away.mean(dim=(0, 2, 3)).unflatten(0, (tries, count)).argmin(dim=0)
    return noise.rows(best * count + torch.arange(count))
