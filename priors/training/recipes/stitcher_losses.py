"""What a stitcher is taught: the true way between two poses, and that its sides meet."""

from dataclasses import dataclass, field, replace

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import binary_cross_entropy_with_logits as cross_entropy

from mapctl.features import LAYOUT
from mapctl.kinematics.fast import compute_joints_world
from mapctl.pose import BodyPose
from mapctl.rotations import lift_ground
from mapctl.skeleton import CANONICAL, TOE_JOINTS
from priors.stitching.latents import DrawnLatents, draw_slow_noise
from priors.stitching.network import PACE, POSE, SEEN_FUTURE, Gaussian, StitcherNetwork
from priors.stitching.posterior import PosteriorNetwork
from priors.stitching.sides import Ends, Sides, count_made, walk_sides
from priors.training.augmentation.transition_windows import Transition

_EASE, _EASE_METRES = 0.4, 0.05


@dataclass(frozen=True)
class LossWeights:
    """Weights of what is learnt."""

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


@dataclass(eq=False)
class TaughtLatents:
    """Latents by three parts of a batch: the posterior's, which has seen the truth; the prior's mean; the prior's
    draws."""

    posterior: PosteriorNetwork
    """Sees the truth."""
    truth: Float[Tensor, "2 batch frames size"]
    """Normalised features from each end's next frame to the other end."""
    missed: Float[Tensor, "2 informed made size"]
    """What the calm answer misses of it, in the first rows, which are given the posterior's."""
    shared: Float[Tensor, "batch shared"]
    """Standard normal noise; zeros in rows at the mean."""
    slow: Float[Tensor, "2 batch made own"]
    """The same, of frames."""
    nats: list[Tensor] = field(default_factory=list)
    """Divergences from the prior by row and dimension, the transition's first and then those of frames."""
    cost: Tensor = field(default_factory=lambda: torch.zeros(()))
    """The transition's divergence from a standard normal distribution, by row and dimension."""
    means: list[Tensor] = field(default_factory=list)
    """Means of the posterior: the transition's, and then those of frames."""

    def share(self, prior: Gaussian, seen: Float[Tensor, "2 batch seen"]) -> Float[Tensor, "batch shared"]:
        """What both sides share over the transition."""
        count = self.missed.shape[1]
        if not count:
            self._count(self.shared[:0], self.shared[:0])
            return prior.draw(self.shared)
        told = self.posterior.tell_shared(self.missed)
        self.cost = told.diverge(Gaussian(torch.zeros_like(told.mean), torch.zeros_like(told.mean)))
        # Held to a prior that sees the ends, the posterior would learn to tell nothing but these.
        self._count(told.detach().diverge(prior.row(slice(count))), told.mean)
        return torch.cat([told.draw(self.shared[:count]), prior.row(slice(count, None)).draw(self.shared[count:])])

    def own(self, prior: Gaussian, encoded: Float[Tensor, "2 batch width"], step: int) -> Float[Tensor, "2 batch own"]:
        """A frame's, of both sides."""
        last = self.truth.shape[2] - 1
        ahead = [min(step + number, last) for number in range(SEEN_FUTURE)]
        told = self.posterior.tell_own(self.truth[:, :, ahead], encoded)
        self._count(told.diverge(prior).mean(dim=0), told.mean[0])
        noise = self.slow[:, :, step]
        informed = torch.arange(len(self.shared)) < self.missed.shape[1]
        return torch.where(informed[:, None], told.draw(noise), prior.draw(noise))

    def count_nats(self) -> tuple[Float[Tensor, "informed shared"], Float[Tensor, "batch own"]]:
        """Count those of what is shared, and sum those of all frames."""
        return self.nats[0], torch.stack(self.nats[1:]).sum(dim=0)

    def _count(self, nats: Tensor, mean: Tensor) -> None:
        self.nats.append(nats)
        self.means.append(mean)


def compute_stitcher_losses(
    network: StitcherNetwork,
    posterior: PosteriorNetwork,
    truth: Transition,
    shares: tuple[float, float],
    weights: LossWeights,
    generator: torch.Generator,
) -> dict[str, Tensor]:
    """Compute the loss, and in plain units the errors it is made of.

    `shares` of the batch, from its first row on, have the posterior's latents, and the prior's mean; these are compared
    with the truth. The rest has draws from the prior, which have only to meet.
    """
    wanted, batch, frames = truth.truth(), len(truth.features), truth.frames
    made = count_made(network, frames)
    informed, compared = (round(batch * share) for share in (shares[0], sum(shares)))
    row = torch.arange(batch)
    calm = ((row >= informed) & (row < compared)).float()
    config, known = network.config, truth.ends()
    latents = TaughtLatents(
        posterior,
        (wanted - network.mean) / network.std,
        miss_calmly(network, truth, known.first(informed)),
        torch.randn(batch, config.shared, generator=generator) * (1 - calm)[:, None],
        draw_slow_noise(batch, made, config.own, generator) * (1 - calm)[:, None, None],
    )
    sides = walk_sides(network, known, frames, latents)
    if sides.alone:
        sides = _forget_backward(sides)
    parts, distance, slip = _compare(network, truth, sides, compared)
    nats = [each[:informed].mean(dim=0) if informed else torch.zeros(1) for each in latents.count_nats()]
    parts |= {
        "shared": latents.cost.mean(dim=0).sum() if informed else torch.zeros(()),
        "prior": nats[0].sum(),
        "own": nats[1].sum(),
    }
    loss = sum((getattr(weights, name) * value for name, value in parts.items()), start=torch.zeros(()))
    return {
        "loss": loss,
        "places_cm": 100 * distance[:, :informed].mean() if informed else torch.zeros(()),
        "calm_cm": 100 * distance[:, informed:].mean() if compared > informed else torch.zeros(()),
        "pace_cm": 100 * slip.mean(),
        "state": parts["state"],
        "contacts": parts["contacts"],
        "feet_cm": 100 * parts["feet"],
        "apart_cm": 100 * parts["stitching"],
        "shared_nats": parts["prior"],
        "own_nats": parts["own"],
        "phase": parts["phase"],
    }


def _compare(
    network: StitcherNetwork, truth: Transition, sides: Sides, compared: int
) -> tuple[dict[str, Tensor], Float[Tensor, "sides compared made joints"], Float[Tensor, "sides compared made joints"]]:
    """Compare the first rows with the truth, and let all of them meet and stand; also return the distances of joints
    from their true places, and the errors of their steps, metres."""
    count, _, made = sides.features.shape[:3]
    true, places = truth.truth()[:count, :compared, :made], place_joints(sides)
    # Windows that interpolation nearly solves count for more, or the network learns to fidget where nobody moves.
    ease = weigh_windows(truth)[:compared]
    wrong = places[:, :compared] - _place_truth(truth, made)[:count, :compared]
    distance = _measure_length(wrong)
    slip = _measure_length(torch.diff(wrong, dim=2, prepend=torch.zeros_like(wrong[:, :, :1])))
    off = ((sides.features[:, :compared] - true) / network.std).abs()
    steps = _measure_length(torch.diff(places[..., list(TOE_JOINTS), :], dim=2))
    # Who was drawn is compared with no truth: toes that its own sides call planted are to stand.
    stand = torch.cat([true[..., POSE.stop :], sides.features[:, compared:, :, POSE.stop :].detach()], dim=1)
    planted = stand[:, :, 1:] * stand[:, :, :-1]
    phases = torch.cat([sides.at_ends[:count, :, None], sides.phases[:, :, : made - 1]], dim=2)[:, :compared]
    parts = {
        "places": (ease * distance.mean(dim=(0, 2, 3))).mean(),
        "pace": (ease * slip.mean(dim=(0, 2, 3))).mean(),
        "state": (ease * (off[..., PACE].mean(dim=-1) + off[..., POSE].mean(dim=-1)).mean(dim=(0, 2))).mean(),
        "contacts": cross_entropy(sides.logits[:, :compared], true[..., POSE.stop :]),
        "feet": (steps * planted).sum() / planted.sum().clamp_min(1),
        "stitching": torch.zeros(()) if sides.alone else measure_apart(places, truth.frames).mean(),
        "phase": (phases - truth.true_phases()[:count, :compared, :made]).abs().mean(),
    }
    return parts, distance, slip


@torch.no_grad()
def miss_calmly(network: StitcherNetwork, truth: Transition, ends: Ends) -> Float[Tensor, "2 informed made size"]:
    """Return what the calm answer to the ends of the first transitions misses of the truth, in units of the features'
    spread."""
    count, made = len(ends.place), count_made(network, truth.frames)
    if not count:
        return ends.features.new_zeros(2, 0, made, LAYOUT.size)
    calm = DrawnLatents.calm(count, made, network.config.shared, network.config.own)
    found = walk_sides(network, ends, truth.frames, calm).features
    return (truth.truth()[:, :count, :made] - found) / network.std


def place_joints(sides: Sides) -> Float[Tensor, "sides batch made joints 3"]:
    """Place the joints of the sides, metres, seen from the first end."""
    shape = sides.features.shape[:2]
    return compute_joints_world(
        sides.features.flatten(0, 1), sides.place.flatten(0, 1), sides.heading.flatten(0, 1), CANONICAL
    ).unflatten(0, shape)


def measure_apart(places: Float[Tensor, "2 batch made joints 3"], frames: int) -> Float[Tensor, "batch overlap"]:
    """Measure the mean distance of the sides' joints in the frames that both made, metres."""
    made = places.shape[2]
    first = frames - made
    return _measure_length(places[0, :, first - 1 :] - places[1, :, first - 1 :].flip(1)).mean(dim=-1)


@torch.no_grad()
def weigh_windows(truth: Transition) -> Float[Tensor, " batch"]:
    """Weigh transitions by the mean error of the interpolation: 1 at 5 cm."""
    body, guess = interpolate(truth)
    error = (body.joints_world() - guess.joints_world()).norm(dim=-1).mean(dim=(1, 2))
    return ((_EASE_METRES + 0.01) / (error + 0.01)) ** _EASE


def interpolate(truth: Transition) -> tuple[BodyPose, BodyPose]:
    """Return the true poses after the first up to the second, and those interpolated between the two."""
    ground, heading = truth.integrate()
    features = truth.features[:, truth.between]
    first = truth.features[:, truth.lead]
    share = (torch.arange(1, truth.frames + 1) / truth.frames)[None, :, None]
    even = torch.lerp(first[:, None], features[:, -1:], share)
    there = ground[:, -1:] * share, heading[:, -1:] * share[..., 0]
    return tuple(_make_body(*each) for each in ((features, ground, heading), (even, *there)))  # type: ignore[return-value]


def _make_body(features: Tensor, ground: Tensor, heading: Tensor) -> BodyPose:
    root = lift_ground(ground) + torch.nn.functional.pad(LAYOUT.pick(features, "root_height"), (1, 1))
    joints = LAYOUT.pick(features, "joint_rotations").unflatten(-1, (-1, 3))
    return BodyPose(root, heading, LAYOUT.pick(features, "root_tilt"), joints)


def _place_truth(truth: Transition, made: int) -> Float[Tensor, "2 batch made joints 3"]:
    """Place the joints of the frames that the sides are to make."""
    ground, heading = truth.integrate()
    places = compute_joints_world(truth.features[:, truth.between].contiguous(), ground, heading, CANONICAL)
    return torch.stack([places[:, :made], places[:, :-1].flip(1)[:, :made]])


def _forget_backward(sides: Sides) -> Sides:
    """Keep the forward side alone."""
    names = ("features", "logits", "place", "heading", "phases", "shares", "at_ends")
    return replace(sides, **{name: getattr(sides, name)[:1] for name in names})


def _measure_length(vectors: Tensor) -> Tensor:
    """Norm whose gradient is finite at zero."""
    return (vectors.square().sum(dim=-1) + 1e-10).sqrt()
