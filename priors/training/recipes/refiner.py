"""Adversarial training of the refiner: rnn paper, sections 4.2.1 and 4.2.2, with departures kept as settings."""

import math
from copy import deepcopy
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.functional import binary_cross_entropy_with_logits as cross_entropy

from mapctl.errors import RequestError
from mapctl.features import LAYOUT, GroundPose, integrate_root, mirror_features
from priors.config import require_at_least
from priors.refiner.end_effectors import compute_end_effectors
from priors.refiner.network import RefinerConfig, RefinerNetwork
from priors.training import run_files
from priors.training.adversarial import Critic, HistoryBuffer
from priors.training.corpus import Corpus, find_window_starts
from priors.training.moment_matching import MatchingSettings, moment_loss

REFINER_MOMENTS = MatchingSettings(feet=0.25, jerk=2.0, pace=0.0, spread=0.5, drift=0.0)
"""That a refiner is held to, as pieces of a window show them."""
_MIN_MOMENT_FRAMES = 8  # frames of a window that moments can be had of


@dataclass(frozen=True)
class AdversarialSettings:
    """The recipe."""

    rounds: int = 4000
    """Rounds after the warm-up: some updates of the refiner, then one of the critic."""
    window: int = 48
    """Frames that the critic sees."""
    batch: int = 32
    """Windows an update."""
    warm_up: int = 75
    """Updates of each before the rounds (section 4.2.2)."""
    head_start: int = 200
    """Updates of the critic before anything else (the paper's 0): a refiner led by a critic that knows nothing spoils
    samples that were nearly good."""
    critic_updates: int = 2
    """Of the critic in each round (the paper's 1)."""
    refiner_updates: int = 1
    """Of the refiner in each round (the paper's 5), to begin with; doubled and halved as either wins."""
    strong: float = 0.01
    """Critic's loss below which the refiner's updates are doubled."""
    weak: float = 1.0
    """Critic's loss above which they are halved."""
    most_updates: int = 20
    """They are never more than this."""
    history: int = 320
    """Refined windows kept for the critic."""
    root: float = 20.0
    """Weight of the squared distance between the roots' ways before and after (Eq. 13), per m^2."""
    optimiser: str = "adam"
    """`adam`, or the paper's `rmsprop`."""
    refiner_rate: float = 1e-4
    """Learning rate (the paper's 0.002)."""
    critic_rate: float = 5e-4
    """Learning rate (the paper's 0.005)."""
    critic_width: int = 128
    """Units of the critic's layers (the paper's 500)."""
    critic_around: int = 2
    """Frames on either side that its first layer sees (the paper's 0): tremble is a matter of three frames."""
    critic_slow: float = 0.05
    """Ground speed of feet, m/s, below which the critic sees it magnified; 0 (the paper's) leaves that out."""
    moments: float = 10.0
    """Weight of feet, jerk and spread as they are in captured windows (see matching.compare; the paper's 0). The
    critic alone lets feet slide twice as fast while it is still learning to see them."""
    average: float = 0.99
    """Share of the past in the running mean of the refiner's weights, which is what is kept; 0 keeps the last."""
    bfloat16: bool = False
    """The networks compute in bfloat16; weights and losses stay in float32."""
    seed: int = 1
    """Of weights, windows and noise."""

    def __post_init__(self):
        require_at_least(self, 1, "rounds", "batch", "refiner_updates", "critic_updates", "most_updates")
        if self.window < (least := 2 * self.critic_around + 2):
            raise RequestError(f"window must be at least {least}, got {self.window}: the critic needs them to see one")
        if self.history < self.batch or self.batch < 2:
            raise RequestError(f"the history must hold a batch of 2 or more, got {self.history} for {self.batch}")
        if self.moments > 0 and self.window < _MIN_MOMENT_FRAMES:
            raise RequestError(
                f"window must be at least {_MIN_MOMENT_FRAMES} for moments to be compared, got {self.window}"
            )
        if not 0 <= self.average < 1:
            raise RequestError(f"average must lie in [0, 1), got {self.average:g}")
        if self.optimiser not in ("adam", "rmsprop"):
            raise RequestError(f"optimiser must be adam or rmsprop, got {self.optimiser!r}")


PAPER = (
    RefinerConfig(
        width=500,
        memory=1000,
        lookahead=0,
        limit=1e6,
        joints=("head", "leftHand", "rightHand", "leftToes", "rightToes"),
    ),
    AdversarialSettings(
        rounds=2000,
        optimiser="rmsprop",
        refiner_rate=2e-3,
        critic_rate=5e-3,
        critic_width=500,
        head_start=0,
        critic_updates=1,
        refiner_updates=5,
        critic_around=0,
        critic_slow=0.0,
        moments=0.0,
        average=0.0,
    ),
)
"""The variant as the paper prints it; it does not say how long it trained."""


@dataclass
class RoundLosses:
    """Of one round."""

    refiner: float
    """Mean of Eq. 9, nats."""
    critic: float
    """Eq. 10 halved, nats: 0.69 where it can tell nothing."""
    told: float
    """Share of the critic's batch that it told apart."""
    updates: int
    """Of the refiner."""

    @property
    def finite(self) -> bool:
        """Whether training has not diverged."""
        return math.isfinite(self.refiner) and math.isfinite(self.critic)


class AdversarialTrainer:
    """Refiner, critic, history and generator, one round at a time."""

    def __init__(self, config: RefinerConfig, settings: AdversarialSettings, corpus: Corpus, raw: Corpus):
        """`corpus` is captured, `raw` sampled from the density that is to be refined."""
        self.settings, self.round, self.updates = settings, 0, settings.refiner_updates
        self.generator = torch.Generator().manual_seed(settings.seed)
        self.corpus, self.raw = corpus, raw
        statistics = _compute_statistics(corpus, config, settings.window)
        with torch.random.fork_rng(devices=[]):
            torch.default_generator.manual_seed(settings.seed)
            self.refiner = RefinerNetwork(config, **statistics)
            reach = {name: statistics[name] for name in ("reach_mean", "reach_std")}
            self.critic = Critic(
                config.joints,
                width=settings.critic_width,
                around=settings.critic_around,
                slow=settings.critic_slow,
                **reach,
            )
        self.averaged_refiner = deepcopy(self.refiner).requires_grad_(False)
        self.given = settings.window + self.refiner.before + config.lookahead
        self.captured = find_window_starts(corpus.lengths, settings.window)
        self.sampled = find_window_starts(raw.lengths, self.given)
        self.optimisers = [
            self._make_optimiser(self.refiner, settings.refiner_rate),
            self._make_optimiser(self.critic, settings.critic_rate),
        ]
        with torch.no_grad():
            first = [self.refiner(self._sample_raw_windows())[0] for _ in range(-(-settings.history // settings.batch))]
        self.history = HistoryBuffer(torch.cat(first)[: settings.history])

    def warm_up(self) -> None:
        """Before the rounds: the critic alone, then both."""
        for _ in range(self.settings.head_start):
            self._criticise()
        for _ in range(self.settings.warm_up):
            self._refine()
            self._criticise()

    def train_round(self) -> RoundLosses:
        """Updates of the refiner, then of the critic, and the balance of section 4.2.2."""
        if self.round == 0:
            self.warm_up()
        updates, settings = self.updates, self.settings
        refiner = sum(self._refine() for _ in range(updates)) / updates
        judged = [self._criticise() for _ in range(settings.critic_updates)]
        critic, told = (sum(each) / settings.critic_updates for each in zip(*judged, strict=True))
        if critic < settings.strong:
            self.updates = min(2 * updates, settings.most_updates)
        elif critic > settings.weak:
            self.updates = max(1, updates // 2)
        self.round += 1
        return RoundLosses(refiner, critic, told, updates)

    def state(self) -> dict[str, Tensor]:
        """Everything a bit-exact continuation needs, flat."""
        tensors = {
            "generator": self.generator.get_state(),
            "history": self.history.windows,
            "counts": torch.tensor([self.round, self.updates]),
        }
        tensors |= {f"averaged.{name}": value for name, value in self.averaged_refiner.state_dict().items()}
        for kind, model, optimiser in self._sides():
            tensors |= {f"{kind}.{name}": value for name, value in model.state_dict().items()}
            tensors |= run_files.flatten_optimiser(optimiser, f"{kind}-optimiser")
        return tensors

    def load_state(self, tensors: dict[str, Tensor]) -> None:
        """Continue from what `state` gave; KeyError or RuntimeError where it is not whole."""
        self.generator.set_state(tensors["generator"])
        self.history = HistoryBuffer(tensors["history"])
        self.round, self.updates = tensors["counts"].tolist()
        self.averaged_refiner.load_state_dict(_strip_prefix("averaged.", tensors))
        for kind, model, optimiser in self._sides():
            model.load_state_dict(_strip_prefix(f"{kind}.", tensors))
            optimiser.load_state_dict(run_files.unflatten_optimiser(optimiser, f"{kind}-optimiser", tensors))

    def _sides(self) -> list[tuple[str, nn.Module, torch.optim.Optimizer]]:
        return [("refiner", self.refiner, self.optimisers[0]), ("critic", self.critic, self.optimisers[1])]

    def _refine(self) -> float:
        """One update of the refiner (Eq. 13), and of its running mean."""
        raw = self._sample_raw_windows()
        with self._autocast():
            refined, _ = self.refiner(raw)
            odds = self.critic(refined.float())
        refined = refined.float()
        loss = cross_entropy(odds.float(), torch.ones(odds.shape))
        total = loss + self.settings.root * _compute_root_error(raw[:, self.refiner.before :], refined)
        if self.settings.moments > 0:
            captured = self._sample_windows(self.corpus, self.captured, self.settings.window)
            total = total + self.settings.moments * moment_loss(refined, captured, REFINER_MOMENTS)
        self._step(self.optimisers[0], self.refiner, total)
        with torch.no_grad():
            for mean, latest in zip(self.averaged_refiner.parameters(), self.refiner.parameters(), strict=True):
                mean.lerp_(latest, 1 - self.settings.average)
        return loss.item()

    def _criticise(self) -> tuple[float, float]:
        """One update of the critic (Eq. 10) on captured windows, fresh refined ones and kept ones."""
        with torch.no_grad(), self._autocast():
            fresh, _ = self.refiner(self._sample_raw_windows())
        made = self.history.mix(fresh.float(), self.generator)
        both = torch.cat([self._sample_windows(self.corpus, self.captured, self.settings.window), made])
        with self._autocast():
            odds = self.critic(both).float()
        truth = torch.cat([torch.ones(len(odds) - len(made)), torch.zeros(len(made))])
        loss = cross_entropy(odds, truth[:, None].expand_as(odds))
        self._step(self.optimisers[1], self.critic, loss)
        return loss.item(), float(((odds.mean(1) > 0) == (truth > 0.5)).float().mean())

    def _step(self, optimiser: torch.optim.Optimizer, model: nn.Module, loss: Tensor) -> None:
        for each in self.optimisers:
            each.zero_grad(set_to_none=True)
        loss.backward()
        nn.utils.clip_grad_norm_(model.parameters(), 5.0)
        optimiser.step()

    def _autocast(self) -> torch.autocast:
        return torch.autocast("cpu", torch.bfloat16, enabled=self.settings.bfloat16)

    def _sample_raw_windows(self) -> Float[Tensor, "batch given size"]:
        return self._sample_windows(self.raw, self.sampled, self.given)

    def _sample_windows(self, corpus: Corpus, starts: Tensor, length: int) -> Tensor:
        picked = torch.randint(len(starts), (self.settings.batch,), generator=self.generator)
        windows = corpus.features[starts[picked, None] + torch.arange(length)]
        mirrored = torch.rand(len(windows), 1, 1, generator=self.generator) < 0.5
        return torch.where(mirrored, mirror_features(windows), windows)

    def _make_optimiser(self, model: nn.Module, rate: float) -> torch.optim.Optimizer:
        if self.settings.optimiser == "rmsprop":
            return torch.optim.RMSprop(model.parameters(), lr=rate, alpha=0.9)
        return torch.optim.Adam(model.parameters(), lr=rate, betas=(0.5, 0.9))


def _compute_root_error(before: Tensor, after: Tensor) -> Tensor:
    """Mean squared distance of the roots' ways and heights (Eq. 13), m^2; `before` may go on longer."""
    before = before[:, : after.shape[1]]
    origin = GroundPose(before.new_zeros(len(before), 2), before.new_zeros(len(before)))
    ground = integrate_root(before, origin)[0] - integrate_root(after, origin)[0]
    height = LAYOUT.pick(before, "root_height") - LAYOUT.pick(after, "root_height")
    return (ground.square().sum(-1) + height[..., 0].square()).mean()


def _compute_statistics(corpus: Corpus, config: RefinerConfig, window: int) -> dict[str, Tensor]:
    """Mean and spread of features and end effectors over captured clips, with floors that keep held joints in hand."""
    features = corpus.features
    mean, std = features.mean(0), features.std(0).clamp(min=0.002)
    bits = LAYOUT.slices["contacts"]
    mean[bits], std[bits] = 0.5, 0.5
    starts = find_window_starts(corpus.lengths, window)[:: max(1, window)]
    reach = torch.cat(
        [
            compute_end_effectors(features[rows[:, None] + torch.arange(window)], config.joints).flatten(0, 1)
            for rows in starts.split(512)
        ]
    )
    return {"mean": mean, "std": std, "reach_mean": reach.mean(0), "reach_std": reach.std(0).clamp(min=0.01)}


def _strip_prefix(prefix: str, tensors: dict[str, Tensor]) -> dict[str, Tensor]:
    return {name.removeprefix(prefix): value for name, value in tensors.items() if name.startswith(prefix)}
