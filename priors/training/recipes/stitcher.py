"""Training of the stitcher: both directions between two poses of mocap, over longer and longer times.

Validation measures, between poses of unseen clips, how near the answers come.
"""

import copy
import itertools
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.functional import binary_cross_entropy_with_logits as cross_entropy

from mapctl.contacts import compute_phases, mirror_phases, reversed_phases
from mapctl.errors import RequestError
from mapctl.features import LAYOUT, GroundPose, integrate_root, mirror_features, reversed_features
from mapctl.kinematics import forward_kinematics
from mapctl.pose import BodyPose
from mapctl.skeleton import CANONICAL, TOE_JOINTS
from priors.stitcher import (
    PACE,
    POSE,
    SEEN_FUTURE,
    DrawnLatents,
    Ends,
    Gaussian,
    PosteriorNetwork,
    Sides,
    Stitcher,
    StitcherConfig,
    StitcherNetwork,
    count_generated,
    join_sides,
    multiply_in_bfloat16,
    walk_sides,
)
from priors.training.data import Corpus, Split
from priors.training.gaps import InbetweenerTrainer
from priors.training.loop import Count, Export, NetworkSettings, make_generator, update_average
from priors.training.windows import WindowPicker, measure_lengths

_SHORTEST, _FIRST_LONGEST = 2, 8  # frames from pose to pose
_LEAST_WINDOW = 16  # frames of the longest transition
_CONTEXT = 10  # frames known before or after, at most
_LENGTH_GROWTH = 0.5  # share of training in which transitions become longer
_AVERAGE = 0.999
_LEAST_SPREAD = 0.05  # of a feature, of the typical one of its block
_EASE = 0.4  # power of the interpolation's error by which windows count less
_EASE_METRES = 0.05  # error at which they count 1
TRIES = 4
"""Draws of which the nearest is taught."""
SHARES = {"informed": 0.4, "calm": 0.3, "nearest": 0.2}
"""Shares of a batch whose latents are the posterior's, which has seen the truth; the prior's mean; and the one of
several draws from the prior that comes nearest to the truth (the variety loss of Gupta et al. 2018, "Social GAN"). The
rest has draws from the prior, which have only to meet."""
WEIGHTS = {
    "positions": 10.0,  # mean distance of joints from their true positions, metres (the paper's FK loss, Eq. 7)
    "pace": 20.0,  # error of joints' steps, metres a frame
    "state": 0.5,  # absolute error of steps, turns and poses, in units of their spread (Eq. 6)
    "contacts": 0.1,  # cross entropy of the contacts, nats
    "feet": 5.0,  # steps of toes that are planted, metres a frame
    "stitching": 5.0,  # mean distance of the two sides' joints where they overlap, metres (Eq. 4)
    "shared": 0.001,  # divergence of the shared latents' posterior from a standard normal distribution, nats
    "prior": 0.02,  # divergence of that posterior, as it is, from its prior, which is to learn it, nats
    "own": 0.02,  # divergence of the frames' latents from their prior, nats a transition
    "phase": 0.3,  # absolute error of the phases
}
"""Weights of the losses."""
VALIDATED_GAPS = (5, 15, 30, 45)
"""Frames between the two poses."""
TEMPERATURES = (0.5, 0.75, 1.0, 1.25, 1.5, 1.75, 2.0, 2.25, 2.5, 2.75, 3.0)
"""Temperatures of draws that are tried."""
_WINDOWS, _DRAWS = 96, 8
_AS_NEAR = 1.01  # of the least error of the best draw


@dataclass(frozen=True, kw_only=True)
class StitcherSettings(NetworkSettings):
    """Train the stitcher, which generates many motions from one pose to another; --batch is in transitions, --window in
    frames of the longest."""

    kind = "stitcher"
    used_by = "use it with --stitcher"
    ours = StitcherConfig()
    least_window = _LEAST_WINDOW

    steps: Count = 12_000
    """Steps in all."""
    window: Count = 61
    """Frames from one pose to the other in the longest transition."""

    def make_trainer(self, parts: Split) -> "StitcherTrainer":
        return StitcherTrainer(self, parts.train)


class StitcherTrainer(InbetweenerTrainer[StitcherNetwork]):
    """Draws transitions, hides what is between their ends, and brings both sides nearer to it."""

    model = Stitcher

    def __init__(self, settings: StitcherSettings, corpus: Corpus):
        self.config = config = settings.find_config()
        self.windows = TransitionWindows(corpus)
        self.longest = min(config.longest, settings.window, max(corpus.lengths) - 2 * _CONTEXT - 1)
        if self.longest < _SHORTEST:
            raise RequestError(f"a stitcher needs clips of {_SHORTEST + 2 * _CONTEXT + 1} frames and more")
        self.gaps = tuple(gap for gap in VALIDATED_GAPS if gap < config.longest)
        device = torch.get_default_device()
        super().__init__(settings, lambda: self._make(config, device))
        _set_moments(self.network, corpus)
        self.begin()
        self.average = copy.deepcopy(self.network).requires_grad_(False)
        """Moving average of the weights: what is measured and exported."""

    def _make(self, config: StitcherConfig, device: torch.device) -> StitcherNetwork:
        network = StitcherNetwork(config)
        self.posterior = PosteriorNetwork(config).to(device)
        """Sees the truth."""
        return network

    def make_optimisers(self) -> dict[str, torch.optim.Optimizer]:
        return {"optimiser": torch.optim.AdamW(self.weights(), lr=self.settings.learning_rate, betas=(0.5, 0.9))}

    def weights(self) -> list[nn.Parameter]:
        return [*super().weights(), *self.posterior.parameters()]

    def networks(self) -> dict[str, nn.Module]:
        return super().networks() | {"posterior": self.posterior, "average": self.average}

    @property
    def exported(self) -> StitcherNetwork:
        return self.average

    def losses(self) -> dict[str, Tensor]:
        longest = _FIRST_LONGEST + max(0, self.longest - _FIRST_LONGEST) * min(1.0, self.progress / _LENGTH_GROWTH)
        longest = max(_SHORTEST, min(round(longest), self.longest))
        frames = int(torch.randint(_SHORTEST, longest + 1, (), generator=self.generator))
        truth = self.windows.draw(self.settings.batch, frames, _draw_known(self.generator), self.generator)
        with multiply_in_bfloat16(self.network, self.posterior, wanted=self.settings.bfloat16):
            parts, errors = find_stitcher_losses(self.network, self.posterior, truth, self.generator)
        return {"loss": torch.stack([WEIGHTS[name] * value for name, value in parts.items()]).sum(), **errors}

    def train_step(self) -> dict[str, float]:
        """Take one update, and bring the average nearer."""
        parts = super().train_step()
        update_average(self.average, self.network, min(_AVERAGE, (1 + self.step) / (10 + self.step)))
        return parts

    def export(self, parts: Split) -> Export:
        """Return the average of the weights, with draws as wide as they come near to the truth."""
        windows = TransitionWindows(parts.validation)
        self.average.temperature.fill_(calibrate_temperature(self.average, windows))
        return super().export(parts)


class Known(NamedTuple):
    """Known ends of a transition."""

    before: int = 0  # frames before the first pose
    after: int = 0  # frames after the second


@dataclass(frozen=True, eq=False)
class Transition:
    """Transitions of one length, with a frame or more on either side."""

    features: Float[Tensor, "batch window size"]  # from the first frame known before to the last after
    phases: Float[Tensor, "batch window 4"]  # phases of both toes
    frames: int  # from one pose to the other
    lead: int  # frames of the window before the first pose
    known: Known  # whether a frame is known

    @property
    def between(self) -> slice:
        """Frames after the first pose, up to and with the second."""
        return slice(self.lead + 1, self.lead + self.frames + 1)

    def rows(self, index: Tensor) -> "Transition":
        """Return some of the transitions."""
        return replace(self, features=self.features[index], phases=self.phases[index])

    def ends(self) -> Ends:
        """Return the input of a stitcher."""
        back, (before, after) = reversed_features(self.features), self.known
        last = self.features.shape[1] - 1 - self.lead - self.frames  # the second pose, counted backwards
        position, turn = self.integrate()
        there, other = self.features[:, self.lead - before : self.lead + 1], back[:, last - after : last + 1]
        return Ends.of(there, other, position[:, -1], turn[:, -1])

    def integrate(self) -> tuple[Float[Tensor, "batch frames 2"], Float[Tensor, "batch frames"]]:
        """Return ground positions and headings of the frames between and of the second pose, seen from the first."""
        return integrate_root(self.features[:, self.between], GroundPose.origin())

    def truth(self) -> Float[Tensor, "2 batch frames size"]:
        """Features from each end's next frame to the other end, in the sides' senses of time."""
        first = self.features.shape[1] - self.lead - self.frames
        back = reversed_features(self.features)[:, first : first + self.frames]
        return torch.stack([self.features[:, self.between], back])

    def place_joints(self, generated: int) -> Float[Tensor, "2 batch generated joints 3"]:
        """Place the joints of the frames that each side is to make first, metres, seen from the first pose."""
        ground, heading = self.integrate()
        positions = BodyPose.of_features_at(self.features[:, self.between], ground, heading).joints_world()
        return torch.stack([positions[:, :generated], positions[:, :-1].flip(1)[:, :generated]])

    def true_phases(self) -> Float[Tensor, "2 batch frames 4"]:
        """Phases of each end and of all frames up to the last before the other end, in the sides' senses of time."""
        first = self.features.shape[1] - self.lead - self.frames
        there = self.phases[:, self.lead : self.lead + self.frames]
        return torch.stack([there, reversed_phases(self.phases)[:, first - 1 : first - 1 + self.frames]])


class TransitionWindows:
    """Draws transitions from a corpus, half of them mirrored."""

    def __init__(self, corpus: Corpus):
        self.features = corpus.features
        self.phases = torch.cat([compute_phases(LAYOUT.pick(clip, "contacts")) for clip in corpus.clips()]).to(
            self.features
        )
        self.picker = WindowPicker(corpus)
        self.starts = corpus.locate_clips()[1]

    def draw(self, batch: int, frames: int, known: Known, generator: torch.Generator) -> Transition:
        """So many transitions of so many frames; RequestError where no clip is so long."""
        lead, rest = max(known.before, 1), max(known.after, 1)  # one frame more shows the pace of the ends
        window = lead + frames + 1 + rest
        clip, first = self.picker.pick(torch.full((batch,), window), generator)
        index = (self.starts[clip] + first)[:, None] + torch.arange(window)
        mirrored = (torch.rand(batch, generator=generator) < 0.5)[:, None, None]
        features, phases = self.features[index], self.phases[index]
        features = torch.where(mirrored, mirror_features(features), features)
        return Transition(features, torch.where(mirrored, mirror_phases(phases), phases), frames, lead, known)


def _draw_known(generator: torch.Generator) -> Known:
    """Two bare poses in two fifths of the cases; in the rest up to 10 frames before, and after or not."""
    share = float(torch.rand((), generator=generator))
    before, after = torch.randint(0, _CONTEXT + 1, (2,), generator=generator).tolist()
    if share < 0.4:
        return Known()
    if share < 0.55:
        return Known(1, min(1, after))
    return Known(max(1, before) if share < 0.75 else _CONTEXT, after if share < 0.8 else 0)


@dataclass(eq=False)
class TaughtLatents(DrawnLatents):
    """The latents of a posterior that has seen the truth in a batch's first rows, and those of noise in the rest."""

    posterior: PosteriorNetwork  # sees the truth
    truth: Float[Tensor, "2 batch frames size"]  # normalised features from each end's next frame to the other end
    missed: Float[Tensor, "2 informed generated size"]  # error of the mean answer, in the informed rows
    nats: list[Tensor] = field(default_factory=list)  # from the prior: the transition's, then those of frames
    cost: Tensor = field(default_factory=lambda: torch.zeros(()))  # from a standard normal

    def share(self, prior: Gaussian) -> Float[Tensor, "batch shared"]:
        count = self.missed.shape[1]
        if not count:
            self.nats.append(self.shared[:0])
            return super().share(prior)
        found = self.posterior.infer_shared(self.missed)
        self.cost = found.diverge(Gaussian(torch.zeros_like(found.mean), torch.zeros_like(found.mean)))
        # Held to a prior that sees the ends, the posterior would learn to encode nothing but these.
        self.nats.append(found.detach().diverge(prior.row(slice(count))))
        return torch.cat([found.draw(self.shared[:count]), super().share(prior)[count:]])

    def own(self, prior: Gaussian, encoded: Float[Tensor, "2 batch width"], step: int) -> Float[Tensor, "2 batch own"]:
        last = self.truth.shape[2] - 1
        ahead = [min(step + number, last) for number in range(SEEN_FUTURE)]
        found = self.posterior.infer_own(self.truth[:, :, ahead], encoded)
        self.nats.append(found.diverge(prior).mean(dim=0))
        informed = torch.arange(self.slow.shape[1]) < self.missed.shape[1]
        return torch.where(informed[:, None], found.draw(self.slow[:, :, step]), super().own(prior, encoded, step))

    def diverge(self) -> dict[str, Tensor]:
        """Return the divergences that are learnt, nats a transition, by the names of their weights."""
        count = self.missed.shape[1]
        if not count:
            return {name: torch.zeros(()) for name in ("shared", "prior", "own")}
        shared, frames = self.nats[0], torch.stack(self.nats[1:]).sum(dim=0)
        prior, own = (each[:count].mean(dim=0).sum() for each in (shared, frames))
        return {"shared": self.cost.mean(dim=0).sum(), "prior": prior, "own": own}


@torch.no_grad()
def miss_calmly(network: StitcherNetwork, truth: Transition) -> Float[Tensor, "2 batch generated size"]:
    """Return what the calm answer to the ends of transitions misses of the truth, in units of the features' spread."""
    count, generated = len(truth.features), count_generated(truth.frames)
    if not count:
        return network.mean.new_zeros(2, 0, generated, len(network.mean))
    calm = DrawnLatents.calm(network.config, count, truth.frames)
    found = walk_sides(network, truth.ends(), truth.frames, calm).features
    return (truth.truth()[:, :, :generated] - found) / network.std


@torch.no_grad()
def sample_nearest(network: StitcherNetwork, truth: Transition, generator: torch.Generator) -> DrawnLatents:
    """Sample several latents for each transition, and return those whose joints come nearest to the truth."""
    count = len(truth.features)
    every = torch.arange(count).repeat(TRIES)
    noise = DrawnLatents.sample(network.config, len(every), truth.frames, generator)
    if not count:
        return noise
    repeated = truth.rows(every)
    sides = walk_sides(network, repeated.ends(), truth.frames, noise)
    away = (sides.place_joints() - repeated.place_joints(count_generated(truth.frames))).norm(dim=-1)
    best = away.mean(dim=(0, 2, 3)).unflatten(0, (TRIES, count)).argmin(dim=0)
    return noise.rows(best * count + torch.arange(count))


def find_stitcher_losses(
    network: StitcherNetwork, posterior: PosteriorNetwork, truth: Transition, generator: torch.Generator
) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
    """Find the losses by the names of their weights, and in plain units the errors that add up to them."""
    batch = len(truth.features)
    informed, calm, compared = (round(batch * share) for share in itertools.accumulate(SHARES.values()))
    row = torch.arange(batch)
    noise = DrawnLatents.sample(network.config, batch, truth.frames, generator)
    noise = noise.still((row >= informed) & (row < calm))
    nearest = row[calm:compared]
    noise = noise.put(nearest, sample_nearest(network, truth.rows(nearest), generator))
    wanted, missed = truth.truth(), miss_calmly(network, truth.rows(row[:informed]))
    latents = TaughtLatents(noise.shared, noise.slow, posterior, (wanted - network.mean) / network.std, missed)
    sides = walk_sides(network, truth.ends(), truth.frames, latents)
    parts, distance, slip = _compare(network, truth, sides, compared)
    parts |= latents.diverge()
    errors = {
        "positions_cm": 100 * distance[:, :informed].mean() if informed else torch.zeros(()),
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
    return parts, errors


def _compare(
    network: StitcherNetwork, truth: Transition, sides: Sides, compared: int
) -> tuple[dict[str, Tensor], Tensor, Tensor]:
    """Compare the first rows with the truth, and let all of them meet and stand; also return the distances of joints
    from their true positions, and the errors of their steps, metres."""
    generated = sides.features.shape[2]
    true, positions = truth.truth()[:, :compared, :generated], sides.place_joints()
    # Windows that interpolation nearly solves count for more, or the network learns to fidget where bodies stand still:
    # by a power of its mean error, 1 at 5 cm.
    with torch.no_grad():
        body, guess = interpolate(truth)
        error = (body.joints_world() - guess.joints_world()).norm(dim=-1).mean(dim=(1, 2))[:compared]
        ease = ((_EASE_METRES + 0.01) / (error + 0.01)) ** _EASE
    wrong = positions[:, :compared] - truth.place_joints(generated)[:, :compared]
    distance = measure_lengths(wrong)
    slip = measure_lengths(torch.diff(wrong, dim=2, prepend=torch.zeros_like(wrong[:, :, :1])))
    off = ((sides.features[:, :compared] - true) / network.std).abs()
    steps = measure_lengths(torch.diff(positions[..., list(TOE_JOINTS), :], dim=2))
    # A draw is compared with no truth: toes that its own sides call planted are to stand.
    stand = torch.cat([true[..., POSE.stop :], sides.features[:, compared:, :, POSE.stop :].detach()], dim=1)
    planted = stand[:, :, 1:] * stand[:, :, :-1]
    both = truth.frames - generated - 1  # first frame of the overlap, as each side counts
    apart = measure_lengths(positions[0, :, both:] - positions[1, :, both:].flip(1)).mean(dim=-1)
    phases = torch.cat([sides.at_ends[:, :, None], sides.phases[:, :, : generated - 1]], dim=2)[:, :compared]
    parts = {
        "positions": (ease * distance.mean(dim=(0, 2, 3))).mean(),
        "pace": (ease * slip.mean(dim=(0, 2, 3))).mean(),
        "state": (ease * (off[..., PACE].mean(dim=-1) + off[..., POSE].mean(dim=-1)).mean(dim=(0, 2))).mean(),
        "contacts": cross_entropy(sides.logits[:, :compared], true[..., POSE.stop :]),
        "feet": (steps * planted).sum() / planted.sum().clamp_min(1),
        "stitching": apart.mean(),
        "phase": (phases - truth.true_phases()[:, :compared, :generated]).abs().mean(),
    }
    return parts, distance, slip


def interpolate(truth: Transition) -> tuple[BodyPose, BodyPose]:
    """Return the true poses after the first up to the second, and those interpolated between the two."""
    ground, heading = truth.integrate()
    features = truth.features[:, truth.between]
    first = truth.features[:, truth.lead]
    share = (torch.arange(1, truth.frames + 1) / truth.frames)[None, :, None]
    even = torch.lerp(first[:, None], features[:, -1:], share)
    there = ground[:, -1:] * share, heading[:, -1:] * share[..., 0]
    return tuple(BodyPose.of_features_at(*each) for each in ((features, ground, heading), (even, *there)))  # type: ignore[return-value]


@torch.no_grad()
def calibrate_temperature(network: StitcherNetwork, windows: TransitionWindows) -> float:
    """Return the largest standard deviation of draws' noise with which the best of eight still comes as near to the
    truth as with any, within a hundredth: as different as can be without wandering off. In gaps between bare poses,
    which count by their calm answer's error."""
    scores = torch.zeros(len(TEMPERATURES))
    for gap in VALIDATED_GAPS[1:]:
        if gap + 4 > int(windows.picker.lengths.max()) or gap >= network.config.longest:
            continue
        truth = windows.draw(_WINDOWS, gap + 1, Known(), make_generator(gap))
        true = interpolate(truth)[0].joints_world()[:, :-1]
        unit = (place_answers(network, truth) - true).norm(dim=-1).mean()
        generator, batch = make_generator(0), len(truth.features)
        draws = [DrawnLatents.sample(network.config, batch, truth.frames, generator) for _ in range(_DRAWS)]
        for number, temperature in enumerate(TEMPERATURES):
            placed = torch.stack([place_answers(network, truth, each.scale(temperature)) for each in draws])
            scores[number] += (placed - true).norm(dim=-1).mean(dim=(2, 3)).amin(dim=0).mean() / unit
    return TEMPERATURES[int((scores <= _AS_NEAR * scores.min()).nonzero().max())]


def place_answers(
    network: StitcherNetwork, truth: Transition, latents: DrawnLatents | None = None
) -> Float[Tensor, "batch frames joints 3"]:
    """Return the joints' positions, metres, seen from the first pose, that a stitcher puts between the ends of
    transitions; with latents at their mean unless others are given."""
    calm = DrawnLatents.calm(network.config, len(truth.features), truth.frames)
    joined = join_sides(walk_sides(network, truth.ends(), truth.frames, latents or calm))
    offsets = CANONICAL.offsets.to(joined.quats)
    return forward_kinematics(offsets, CANONICAL.parents, joined.root_position, joined.quats)[0]


def _set_moments(network: StitcherNetwork, corpus: Corpus) -> None:
    """Set mean and spread of features, and of how they change from frame to frame, to those of the data and its mirror
    image; contacts count by halves."""
    both = torch.cat([corpus.features, mirror_features(corpus.features)])
    change = torch.cat([torch.diff(clip, dim=0) for clip in corpus.clips()]).std(dim=0)
    network.mean.copy_(both.mean(dim=0))
    for spread, buffer in ((both.std(dim=0), network.std), (change, network.change)):
        for block in LAYOUT.slices.values():
            typical = spread[block].square().mean().sqrt()
            buffer[block] = spread[block].clamp_min(float(_LEAST_SPREAD * typical) or 1e-6)
    network.mean[LAYOUT.slices["contacts"]] = network.std[LAYOUT.slices["contacts"]] = 0.5
