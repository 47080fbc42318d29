"""Adversarial training of the refiner: Wang et al. 2019, sections 4.2.1 and 4.2.2, with departures kept as settings."""

from collections.abc import Callable, Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass, field

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.functional import binary_cross_entropy_with_logits as cross_entropy

from mapctl.errors import RequestError
from priors.config import require_at_least
from priors.refiner.network import RefinerConfig, RefinerNetwork
from priors.training.adversaries.end_effectors import Critic
from priors.training.adversaries.guard import find_winner
from priors.training.adversaries.history import HistoryBuffer
from priors.training.adversaries.statistics import compute_statistics
from priors.training.corpus import Corpus, Split
from priors.training.moment_matching import moment_loss
from priors.training.parallel import TrainingGroup
from priors.training.recipe import Row, average
from priors.training.recipes.refining.samples import REFINER_MOMENTS, SampleRecipe, compute_root_error
from priors.training.trainer import Trainer, draw_weights
from priors.training.windows import FeatureWindows

_MIN_MOMENT_FRAMES = 8  # frames of a window that moments can be had of


@dataclass(frozen=True)
class AdversarialSettings:
    """How a refiner is trained."""

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
    """Updates of the critic in each round (the paper's 1)."""
    refiner_updates: int = 1
    """Initial updates of the refiner in each round (the paper's 5); doubled and halved as either wins."""
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
    """Weight of feet, jerk and spread as they are in captured windows (see moment_matching.moment_loss; the paper's 0).
    The critic alone lets feet slide twice as fast while it is still learning to see them."""
    average: float = 0.99
    """Share of the past in the running mean of the refiner's weights, which is what is kept; 0 keeps the last."""
    bfloat16: bool = False
    """The networks compute in bfloat16; weights and losses stay in float32."""
    seed: int = 1
    """Seed of weights, windows and noise."""

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


class AdversarialTrainer(Trainer[RefinerNetwork]):
    """Refiner, critic and history, one round at a time. What is kept is the running mean of the refiner's weights."""

    def __init__(
        self,
        config: RefinerConfig,
        settings: AdversarialSettings,
        corpus: Corpus,
        raw: Corpus,
        evaluate: Callable[[RefinerNetwork], Row] = lambda network: {},
    ):
        """`corpus` is captured, `raw` sampled from the density that is to be refined; `evaluate` measures a refiner."""
        super().__init__(steps=settings.rounds, seed=settings.seed)
        self.settings, self.updates, self.evaluate = settings, settings.refiner_updates, evaluate
        statistics = compute_statistics(corpus, config, settings.window)
        self.refiner, self.critic = draw_weights(lambda: _make_sides(config, settings, statistics), settings.seed)
        self.network = deepcopy(self.refiner).requires_grad_(False)
        self.captured = FeatureWindows(corpus, settings.window)
        self.raw = FeatureWindows(raw, settings.window + self.refiner.before + config.lookahead)
        self.refiner_optimiser = self._make_optimiser(self.refiner, settings.refiner_rate)
        self.critic_optimiser = self._make_optimiser(self.critic, settings.critic_rate)
        with torch.no_grad():
            first = [self.refiner(self._draw(self.raw))[0] for _ in range(-(-settings.history // settings.batch))]
        self.history = HistoryBuffer(torch.cat(first)[: settings.history])

    def join(self, group: TrainingGroup) -> None:
        """Train as one of a group from here on, each with its part of the history."""
        super().join(group)
        self.history = self.history.split(group)

    def networks(self) -> dict[str, nn.Module]:
        """All that is learnt, by its name in checkpoints."""
        return {"averaged": self.network, "refiner": self.refiner, "critic": self.critic}

    def optimisers(self) -> dict[str, torch.optim.Optimizer]:
        """One for each side."""
        return {"refiner-optimiser": self.refiner_optimiser, "critic-optimiser": self.critic_optimiser}

    def warm_up(self) -> None:
        """Before the rounds: the critic alone, then both."""
        for _ in range(self.settings.head_start):
            self._criticise()
        for _ in range(self.settings.warm_up):
            self._refine()
            self._criticise()

    def train_step(self) -> dict[str, float]:
        """Updates of the refiner, then of the critic, and the balance of section 4.2.2.

        Mean of Eq. 9 and half of Eq. 10 in nats, where 0.69 is a critic that can tell nothing; the share of its batch
        that the critic told apart; and how often the refiner was updated.
        """
        if self.step == 0:
            self.warm_up()
        updates, settings = self.updates, self.settings
        refiner = sum(self._refine() for _ in range(updates)) / updates
        judged = [self._criticise() for _ in range(settings.critic_updates)]
        critic, told = (sum(each) / settings.critic_updates for each in zip(*judged, strict=True))
        if critic < settings.strong:
            self.updates = min(2 * updates, settings.most_updates)
        elif critic > settings.weak:
            self.updates = max(1, updates // 2)
        self.step += 1
        return {"refiner": refiner, "critic": critic, "told": told, "updates": updates}

    def validate(self, corpus: Corpus) -> Row:
        """Measures of refined samples beside mocap's (see `RefinerEvaluator`, which holds validation clips)."""
        return self.evaluate(self.network)

    def state(self) -> dict[str, Tensor]:
        """Everything that a bit-exact continuation needs."""
        counts = torch.tensor([self.step, self.updates])
        return {**super().state(), "history": self.group.gather(self.history.windows), "counts": counts}

    def load_state(self, tensors: Mapping[str, Tensor], step: int) -> None:
        """Go on from what `state` gave; KeyError or RuntimeError where it is not whole."""
        super().load_state(tensors, step)
        self.history = HistoryBuffer(tensors["history"])
        _, self.updates = tensors["counts"].tolist()

    def _refine(self) -> float:
        """One update of the refiner (Eq. 13), and of its running mean."""
        raw = self._draw(self.raw)
        with self._autocast():
            refined, _ = self.refiner(raw)
            odds = self.critic(refined.float())
        refined = refined.float()
        loss = cross_entropy(odds.float(), torch.ones(odds.shape))
        total = loss + self.settings.root * compute_root_error(raw[:, self.refiner.before :], refined)
        if self.settings.moments > 0:
            captured = self._draw(self.captured)
            total = total + self.settings.moments * moment_loss(refined, captured, REFINER_MOMENTS)
        told = self._step(self.refiner_optimiser, self.refiner, total, {"loss": loss})
        with torch.no_grad():
            for mean, latest in zip(self.network.parameters(), self.refiner.parameters(), strict=True):
                mean.lerp_(latest, 1 - self.settings.average)
        return told["loss"]

    def _criticise(self) -> tuple[float, float]:
        """One update of the critic (Eq. 10) on captured windows, fresh refined ones and kept ones."""
        with torch.no_grad(), self._autocast():
            fresh, _ = self.refiner(self._draw(self.raw))
        made = self.history.mix(fresh.float(), self.generator)
        both = torch.cat([self._draw(self.captured), made])
        with self._autocast():
            odds = self.critic(both).float()
        truth = torch.cat([torch.ones(len(odds) - len(made)), torch.zeros(len(made))])
        loss = cross_entropy(odds, truth[:, None].expand_as(odds))
        right = ((odds.mean(1) > 0) == (truth > 0.5)).float().mean()
        told = self._step(self.critic_optimiser, self.critic, loss, {"loss": loss, "right": right})
        return told["loss"], told["right"]

    def _step(
        self, optimiser: torch.optim.Optimizer, model: nn.Module, loss: Tensor, told: Mapping[str, Tensor]
    ) -> dict[str, float]:
        for each in self.optimisers().values():
            each.zero_grad(set_to_none=True)
        means = self.differentiate(loss, model.parameters(), told)
        nn.utils.clip_grad_norm_(model.parameters(), 5.0)
        optimiser.step()
        return means

    def _autocast(self) -> torch.autocast:
        return torch.autocast("cpu", torch.bfloat16, enabled=self.settings.bfloat16)

    def _draw(self, windows: FeatureWindows) -> Float[Tensor, "batch frames size"]:
        return windows.draw(self.group.share(self.settings.batch), self.generator).features

    def _make_optimiser(self, model: nn.Module, rate: float) -> torch.optim.Optimizer:
        if self.settings.optimiser == "rmsprop":
            return torch.optim.RMSprop(model.parameters(), lr=rate, alpha=0.9)
        return torch.optim.Adam(model.parameters(), lr=rate, betas=(0.5, 0.9))


@dataclass(frozen=True)
class RefinerRecipe(SampleRecipe[AdversarialSettings, AdversarialTrainer]):
    """What to train a refiner on, and how.

    A guard watches held-out samples: the best refiner seen is kept, and training stops and restores it where one side
    wins.
    """

    guards = ("refiner", "critic", "told")
    config: RefinerConfig = field(default_factory=RefinerConfig)
    """The network."""
    settings: AdversarialSettings = field(default_factory=AdversarialSettings)
    """How it is trained."""

    @property
    def most_processes(self) -> int:
        """How many processes can share a round: half of what each takes goes into its history."""
        return self.settings.batch // 2

    def make_trainer(self, parts: Split) -> AdversarialTrainer:
        """With samples of the density, to train on and to be measured."""
        return AdversarialTrainer(self.config, self.settings, parts.train, *self.draw_samples(parts))

    def format_news(self, rows: Sequence[Row]) -> str:
        """One line on the losses of some rounds."""
        refiner, critic, told = (average(rows, name) for name in self.guards)
        return f"refiner {refiner:.3f}, critic {critic:.3f} nats, {told:.2f} told apart, {rows[-1]['updates']} updates"

    def find_stop_reason(self, trainer: AdversarialTrainer, rows: Sequence[Row]) -> str | None:
        """Why to stop after these losses since the last line of news, if there is a reason."""
        where = f"{self.counter} {trainer.step}"
        return find_winner(rows, losses=("refiner", "critic"), least=self.report_steps, step=where)

    def format_command(self) -> str:
        """What to type for the same run, for the card; options that are the defaults are left out."""
        paper, parts = self.config == PAPER[0], self.format_begin()
        usual = PAPER[1] if paper else AdversarialSettings()
        parts += self.format_changed(usual, "batch", "window", "seed", rounds="steps")
        parts += ["--bfloat16"] * self.settings.bfloat16 + ["--paper"] * paper
        return " ".join(parts + self.format_processes() + self.format_ending())


def _make_sides(
    config: RefinerConfig, settings: AdversarialSettings, statistics: dict[str, Tensor]
) -> tuple[RefinerNetwork, Critic]:
    """Refiner and critic, their weights drawn in this order."""
    refiner = RefinerNetwork(config, **statistics)
    critic = Critic(
        config.joints,
        width=settings.critic_width,
        around=settings.critic_around,
        slow=settings.critic_slow,
        **{name: statistics[name] for name in ("reach_mean", "reach_std")},
    )
    return refiner, critic
