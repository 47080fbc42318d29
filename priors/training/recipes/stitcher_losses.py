"""What a stitcher is taught: the true way between two poses, and that its sides meet."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import binary_cross_entropy_with_logits as cross_entropy

from mapctl.pose import BodyPose
from mapctl.skeleton import TOE_JOINTS
from priors.stitching.latents import DrawnLatents
from priors.stitching.network import PACE, POSE, SEEN_FUTURE, Gaussian, StitcherNetwork
from priors.stitching.posterior import PosteriorNetwork
from priors.stitching.sides import Sides, count_made, walk_sides
from priors.training.augmentation.transition_windows import Transition

_EASE_METRES = 0.05


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


@dataclass(frozen=True)
class LossWeights:
    """Weights of what is learnt; each loss is divided by its mean before training where `relative`."""

    places: float = 10.0
    """Mean distance of joints from their true places, metres (the paper's FK loss, Eq. 7)."""
    pace: float = 20.0
    """Error of joints' steps, metres a frame."""
    state: float = 0.5
    """Absolute error of steps, turns and poses, in units of their spread (Eq. 6)."""
    contacts: float = 0.1
    """Cross entropy of the contacts, nats."""
    feet: float = 5.0
    """Steps of toes that are planted, metres a frame."""
    stitching: float = 5.0
    """Mean distance of the two sides' joints where they overlap, metres (Eq. 4)."""
    shared: float = 0.001
    """Divergence of the posterior of what both sides share from a standard normal distribution, nats."""
    prior: float = 0.02
    """Divergence of that posterior, as it is, from its prior, which is to learn it, nats."""
    own: float = 0.02
    """Divergence of the frames' latents from their prior, nats a transition."""
    phase: float = 0.3
    """Absolute error of the phases."""
    ease: float = 0.4
    """Power of the interpolation's error by which windows count less; 0 lets all count the same."""

    def weigh(self, parts: Mapping[str, Tensor]) -> Tensor:
        """Return the loss."""
        return torch.stack([getattr(self, name) * value for name, value in parts.items()]).sum()


@dataclass(frozen=True)
class Shares:
    """Shares of a batch by where latents come from; the rest has draws from the prior, which have only to meet."""

    informed: float = 0.4
    """From the posterior, which has seen the truth."""
    calm: float = 0.3
    """The prior's mean."""
    nearest: float = 0.2
    """The one of several draws from the prior that comes nearest to the truth (the variety loss of Gupta et al. 2018,
    "Social GAN"): so draws are taught to come near to all that may be meant, where the posterior teaches what a latent
    is to say."""

    def count(self, batch: int) -> tuple[int, int, int]:
        """Return the rows at which the first three end."""
        told = self.informed, self.informed + self.calm, self.informed + self.calm + self.nearest
        informed, calm, nearest = (round(batch * share) for share in told)
        return informed, calm, nearest


def find_stitcher_losses(
    network: StitcherNetwork,
    posterior: PosteriorNetwork,
    truth: Transition,
    shares: Shares,
    ease: float,
    generator: torch.Generator,
) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
    """Find the losses by the names of their weights, and in plain units the errors that they are made of."""
    batch = len(truth.features)
    informed, calm, compared = shares.count(batch)
    row = torch.arange(batch)
    noise = DrawnLatents.sample(network.config, batch, count_made(network, truth.frames), generator)
    noise = noise.still((row >= informed) & (row < calm))
    nearest = row[calm:compared]
    noise = noise.put(nearest, sample_nearest(network, truth.rows(nearest), generator))
    wanted, missed = truth.truth(), miss_calmly(network, truth.rows(row[:informed]))
    latents = TaughtLatents(posterior, (wanted - network.mean) / network.std, missed, noise)
    sides = walk_sides(network, truth.ends(), truth.frames, latents)
    parts, distance, slip = _compare(network, truth, sides, compared, ease)
    parts |= latents.diverge()
    told = {
        "places_cm": 100 * distance[:, :informed].mean() if informed else torch.zeros(()),
        "calm_cm": 100 * distance[:, informed:calm].mean() if calm > informed else torch.zeros(()),
        "nearest_cm": 100 * distance[:, calm:].mean() if compared > calm else torch.zeros(()),
        "pace_cm": 100 * slip.mean(),
        "state": parts["state"],
        "contacts": parts["contacts"],
        "feet_cm": 100 * parts["feet"],
        "apart_cm": 100 * parts["stitching"],
        "shared_nats": parts["prior"],
        "own_nats": parts["own"],
        "phase": parts["phase"],
    }
    return parts, told


def _compare(
    network: StitcherNetwork, truth: Transition, sides: Sides, compared: int, power: float
) -> tuple[dict[str, Tensor], Float[Tensor, "sides compared made joints"], Float[Tensor, "sides compared made joints"]]:
    """Compare the first rows with the truth, and let all of them meet and stand; also return the distances of joints
    from their true places, and the errors of their steps, metres."""
    made = sides.features.shape[2]
    true, places = truth.truth()[:, :compared, :made], sides.place_joints()
    # Windows that interpolation nearly solves count for more, or the network learns to fidget where nobody moves.
    ease = weigh_windows(truth, power)[:compared]
    wrong = places[:, :compared] - truth.place_joints(made)[:, :compared]
    distance = _measure_length(wrong)
    slip = _measure_length(torch.diff(wrong, dim=2, prepend=torch.zeros_like(wrong[:, :, :1])))
    off = ((sides.features[:, :compared] - true) / network.std).abs()
    steps = _measure_length(torch.diff(places[..., list(TOE_JOINTS), :], dim=2))
    # Who was drawn is compared with no truth: toes that its own sides call planted are to stand.
    stand = torch.cat([true[..., POSE.stop :], sides.features[:, compared:, :, POSE.stop :].detach()], dim=1)
    planted = stand[:, :, 1:] * stand[:, :, :-1]
    phases = torch.cat([sides.at_ends[:, :, None], sides.phases[:, :, : made - 1]], dim=2)[:, :compared]
    parts = {
        "places": (ease * distance.mean(dim=(0, 2, 3))).mean(),
        "pace": (ease * slip.mean(dim=(0, 2, 3))).mean(),
        "state": (ease * (off[..., PACE].mean(dim=-1) + off[..., POSE].mean(dim=-1)).mean(dim=(0, 2))).mean(),
        "contacts": cross_entropy(sides.logits[:, :compared], true[..., POSE.stop :]),
        "feet": (steps * planted).sum() / planted.sum().clamp_min(1),
        "stitching": measure_apart(places, truth.frames).mean(),
        "phase": (phases - truth.true_phases()[:, :compared, :made]).abs().mean(),
    }
    return parts, distance, slip


def measure_apart(places: Float[Tensor, "2 batch made joints 3"], frames: int) -> Float[Tensor, "batch overlap"]:
    """Measure the mean distance of the sides' joints in the frames that both made, metres."""
    made = places.shape[2]
    first = frames - made
    return _measure_length(places[0, :, first - 1 :] - places[1, :, first - 1 :].flip(1)).mean(dim=-1)


@torch.no_grad()
def weigh_windows(truth: Transition, power: float) -> Float[Tensor, " batch"]:
    """Weigh transitions by a power of the mean error of the interpolation: 1 at 5 cm."""
    body, guess = interpolate(truth)
    error = (body.joints_world() - guess.joints_world()).norm(dim=-1).mean(dim=(1, 2))
    return ((_EASE_METRES + 0.01) / (error + 0.01)) ** power


def interpolate(truth: Transition) -> tuple[BodyPose, BodyPose]:
    """Return the true poses after the first up to the second, and those interpolated between the two."""
    ground, heading = truth.integrate()
    features = truth.features[:, truth.between]
    first = truth.features[:, truth.lead]
    share = (torch.arange(1, truth.frames + 1) / truth.frames)[None, :, None]
    even = torch.lerp(first[:, None], features[:, -1:], share)
    there = ground[:, -1:] * share, heading[:, -1:] * share[..., 0]
    return tuple(BodyPose.of_features_at(*each) for each in ((features, ground, heading), (even, *there)))  # type: ignore[return-value]


def _measure_length(vectors: Tensor) -> Tensor:
    """Norm whose gradient is finite at zero."""
    return (vectors.square().sum(dim=-1) + 1e-10).sqrt()
