"""Adversarial training of the refiner: Wang et al. 2019, sections 4.2.1 and 4.2.2, with departures kept as settings."""

import math
from collections.abc import Callable, Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass, field
from functools import cached_property

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.functional import binary_cross_entropy_with_logits as cross_entropy

from mapctl.errors import RequestError
from mapctl.features import LAYOUT, PRIOR_FPS, GroundPose, integrate_root
from mapctl.metrics import measure
from mapctl.metrics.realism import RealismSettings, canonical_positions, compute_held_out_accuracy, cut_windows
from mapctl.pose import decode
from priors import checkpoints
from priors.checkpoints import require_at_least
from priors.lstm_gmm import density
from priors.lstm_gmm.density import LstmGmmDensity
from priors.refiner import LstmRefiner, RefinerConfig, RefinerNetwork, compute_end_effectors, count_channels
from priors.training.data import Corpus, Split, find_window_starts
from priors.training.loop import Export, Gathered, HistoryBuffer, Recipe, Row, Trainer, draw_weights
from priors.training.moment_matching import MatchingSettings, moment_loss
from priors.training.windows import FeatureWindows

_MIN_MOMENT_FRAMES = 8  # frames of a window that moments can be had of
_MOMENTS = MatchingSettings(feet=0.25, jerk=2.0, pace=0.0, spread=0.5, drift=0.0)  # as pieces of a window show them
_CRITIC_WON = 0.98  # share that the critic classifies correctly, over a report, from which it has won
_BETAS = (0.5, 0.9)
_FOOT_JOINTS = ("leftFoot", "leftToes", "rightFoot", "rightToes")
_WARM_UP_FRAMES = 60  # frames of a clip that condition the density before it runs freely


@dataclass(frozen=True)
class AdversarialSettings:
    """How a refiner is trained."""

    steps: int = 4000
    """Rounds after the warm-up: some updates of the refiner, then some of the critic."""
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
    """Weight of the squared distance between the root trajectories before and after (Eq. 13), per m^2."""
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
        require_at_least(self, 1, "steps", "batch", "refiner_updates", "critic_updates", "most_updates")
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
        super().__init__(steps=settings.steps, seed=settings.seed)
        self.settings, self.updates, self.evaluate = settings, settings.refiner_updates, evaluate
        statistics = compute_statistics(corpus, config, settings.window)
        self.refiner, self.critic = draw_weights(lambda: _make_sides(config, settings, statistics), settings.seed)
        self.network = deepcopy(self.refiner).requires_grad_(False)
        self.captured = FeatureWindows(corpus, settings.window)
        self.raw = FeatureWindows(raw, settings.window + self.refiner.before + config.lookahead)
        self.refiner_optimiser = torch.optim.Adam(self.refiner.parameters(), lr=settings.refiner_rate, betas=_BETAS)
        self.critic_optimiser = torch.optim.Adam(self.critic.parameters(), lr=settings.critic_rate, betas=_BETAS)
        with torch.no_grad():
            first = [self.refiner(self._draw(self.raw))[0] for _ in range(-(-settings.history // settings.batch))]
        self.history = HistoryBuffer(torch.cat(first)[: settings.history])

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
        """Return everything that a continuation needs, but the step."""
        updates = torch.tensor(self.updates)
        return {**super().state(), "history": self.history.windows, "updates": updates}

    def load_state(self, tensors: Mapping[str, Tensor], step: int) -> None:
        """Go on from what `state` returned; KeyError or RuntimeError where it is not whole."""
        super().load_state(tensors, step)
        self.history = HistoryBuffer(tensors["history"])
        self.updates = int(tensors["updates"])

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
            total = total + self.settings.moments * moment_loss(refined, captured, _MOMENTS)
        self._step(self.refiner_optimiser, self.refiner, total)
        with torch.no_grad():
            for mean, latest in zip(self.network.parameters(), self.refiner.parameters(), strict=True):
                mean.lerp_(latest, 1 - self.settings.average)
        return float(loss.detach())

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
        self._step(self.critic_optimiser, self.critic, loss)
        return float(loss.detach()), float(right)

    def _step(self, optimiser: torch.optim.Optimizer, model: nn.Module, loss: Tensor) -> None:
        for each in self.optimisers().values():
            each.zero_grad(set_to_none=True)
        loss.backward()
        nn.utils.clip_grad_norm_(model.parameters(), 5.0)
        optimiser.step()

    def _autocast(self) -> torch.autocast:
        return torch.autocast("cpu", torch.bfloat16, enabled=self.settings.bfloat16)

    def _draw(self, windows: FeatureWindows) -> Float[Tensor, "batch frames size"]:
        return windows.draw(self.settings.batch, self.generator).features


@dataclass(frozen=True)
class RefinerRecipe(Recipe[RefinerConfig, AdversarialSettings, AdversarialTrainer]):
    """What to train a refiner on, and how.

    The best refiner by held-out samples is kept, and training stops where one side wins.
    """

    kind = "refiner"
    keeps_best = True
    uses_gpu = False
    config: RefinerConfig = field(default_factory=RefinerConfig)
    settings: AdversarialSettings = field(default_factory=AdversarialSettings)
    match: str | None = None
    """Regular expression for the clips; the density's own if None."""
    report_steps: int = 50
    """Rounds of whose losses the log holds the means."""
    validate_steps: int = 300
    """Rounds between measures of held-out samples."""
    density: str = "locomotion"
    """Prior whose samples are refined."""
    samples: int = 300
    """Motions of `seconds` drawn from the density to train on."""
    seconds: float = 10.0
    """Duration of each sampled motion, s."""
    judged: int = 24
    """Motions drawn to be measured, and held-out clips at least, if there are as many."""
    realism: RealismSettings = field(default_factory=RealismSettings)
    """Settings of the classifier that separates samples from mocap."""

    @cached_property
    def prior(self) -> LstmGmmDensity:
        """The density, loaded."""
        return density.load(self.density)

    @property
    def chosen(self) -> str:
        """Regular expression for the clips."""
        return self.prior.card.data.get("match", "") if self.match is None else self.match

    @property
    def split_seed(self) -> int:
        """Seed of the density's split, so that its held-out clips stay held out."""
        return self.prior.card.data.get("split_seed", self.settings.seed)

    def make_trainer(self, parts: Split) -> AdversarialTrainer:
        """Make the trainer with samples of the density, to train on and to be measured."""
        raw, measured = self._sample(parts)
        judge = RefinerEvaluator.of(measured, parts.validation, self.realism)
        return AdversarialTrainer(self.config, self.settings, parts.train, raw, judge)

    def _sample(self, parts: Split) -> tuple[Corpus, Corpus]:
        """Sample motions to train on, and others to measure."""
        generator, frames = torch.Generator().manual_seed(self.settings.seed), round(self.seconds * PRIOR_FPS)
        first, second = (
            sample_corpus(self.prior, parts.train, count, frames, generator) for count in (self.samples, self.judged)
        )
        return first, second

    def score(self, row: Row) -> float:
        """Measure how far foot speed, jitter and classifier accuracy are from mocap's."""
        return compute_realism_gap(row)

    def find_stop_reason(self, trainer: AdversarialTrainer, rows: Sequence[Row]) -> str | None:
        """Return why to stop after these losses since the last report: a loss is not finite, or the critic classifies
        nearly all correctly."""
        if not all(math.isfinite(rows[-1][name]) for name in ("refiner", "critic")):
            return f"training diverged at step {trainer.step}"
        if len(rows) >= self.report_steps and sum(row["told"] for row in rows) / len(rows) > _CRITIC_WON:
            return "the critic has won"
        return None

    def describe_run(self, trainer: AdversarialTrainer, corpus: Corpus) -> dict[str, Row]:
        """Describe what must not change between a run's parts."""
        found = super().describe_run(trainer, corpus)
        return {**found, "data": found["data"] | {"density": self.density, "match": self.chosen}}

    def export(self, trainer: AdversarialTrainer, gathered: Gathered, curve: Sequence[Row]) -> Export:
        """Return the best refiner so far, measured on the test clips, by which none was chosen."""
        data = {
            "density": self.density,
            "density_config": self.prior.reference.config.as_card(),
            "samples": self.samples,
            **self.describe_data(gathered),
        }
        best = min(curve, key=compute_realism_gap)
        judge = RefinerEvaluator.of(self._sample(gathered.parts)[1], gathered.parts.test, self.realism)
        # Feet that never touch the floor have no speed there, and a card holds no other numbers than finite ones.
        test = {name: value if math.isfinite(value) else None for name, value in judge(trainer.network).items()}
        return Export(trainer.network.state_dict(), data, {"step": best["step"], "test": test})


class Critic(nn.Module):
    """Tells captured windows from refined ones by end effectors and contact bits."""

    reach_mean: Tensor
    reach_std: Tensor

    def __init__(
        self, joints: Sequence[str], *, width: int, around: int, slow: float, reach_mean: Tensor, reach_std: Tensor
    ):
        """`width` units in the first layer and in each direction of the LSTM; the first layer sees `around` frames on
        either side of its own, and feet's ground speeds under `slow` (m/s) magnified, unless that is 0.
        """
        super().__init__()
        self.joints = tuple(joints)
        self.register_buffer("reach_mean", reach_mean.clone())
        self.register_buffer("reach_std", reach_std.clone())
        self.slow = slow
        self.magnified_columns = [
            len(joints) + number for number, name in enumerate(joints) if slow > 0 and name in _FOOT_JOINTS
        ]
        seen = count_channels(joints) + 2 * len(self.magnified_columns) + 2
        self.first = nn.Conv1d(seen, width, 2 * around + 1)
        self.lstm = nn.LSTM(width, width, batch_first=True, bidirectional=True)
        self.last = nn.Linear(2 * width, 1)

    def forward(self, features: Float[Tensor, "batch frames size"]) -> Float[Tensor, "batch judged"]:
        """Logits, frame by frame, that a window was captured; for the frames that have enough on either side."""
        ends = compute_end_effectors(features, self.joints)
        seen = [(ends - self.reach_mean) / self.reach_std, 2 * LAYOUT.pick(features, "contacts")[:, 1:] - 1]
        if self.magnified_columns:
            # A foot that slides by 10 cm/s is a twentieth of the spread of feet's speeds, and what every viewer sees.
            ground = ends.unflatten(-1, (-1, 3))[:, :, self.magnified_columns, ::2]
            seen.append(0.5 * torch.asinh(ground / self.slow).flatten(2))
        seen = torch.cat(seen, dim=-1).transpose(1, 2)
        hidden, _ = self.lstm(torch.nn.functional.leaky_relu(self.first(seen), 0.2).transpose(1, 2))
        return self.last(hidden)[..., 0]


def compute_root_error(before: Tensor, after: Tensor) -> Tensor:
    """Mean squared distance of root trajectories and heights (Wang et al. 2019, Eq. 13), m^2; `before` may go on
    longer."""
    before = before[:, : after.shape[1]]
    origin = GroundPose(before.new_zeros(len(before), 2), before.new_zeros(len(before)))
    ground = integrate_root(before, origin)[0] - integrate_root(after, origin)[0]
    height = LAYOUT.pick(before, "root_height") - LAYOUT.pick(after, "root_height")
    return (ground.square().sum(-1) + height[..., 0].square()).mean()


def compute_statistics(corpus: Corpus, config: RefinerConfig, window: int) -> dict[str, Tensor]:
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


@dataclass(frozen=True, eq=False)
class RefinerEvaluator:
    """Measures refined samples beside the raw ones and mocap that training does not see."""

    raw: Float[Tensor, "count frames size"]
    """Samples that are refined anew each time."""
    mocap: dict[str, float]
    """Mocap's measures."""
    windows: list[Tensor]
    """Mocap's windows for the classifier."""
    settings: RealismSettings
    """Settings of the realism classifier."""

    @staticmethod
    def of(raw: Corpus, held: Corpus, settings: RealismSettings) -> "RefinerEvaluator":
        """Against clips that training does not see: of those that a refiner is chosen by, or of those that are left to
        measure the chosen one."""
        clips = [clip for clip in held.clips() if len(clip) > settings.windows.frames]
        motions = [decode(clip, GroundPose.origin()) for clip in clips]
        windows = [cut_windows(canonical_positions(motion), settings.windows) for motion in motions]
        return RefinerEvaluator(torch.stack(raw.clips()), _average_measures(clips), windows, settings)

    def __call__(self, network: RefinerNetwork) -> dict[str, float]:
        """Contact speed and jitter as ratios to mocap's, and the classifier's accuracy."""
        refiner = LstmRefiner("in training", network.eval(), _NO_CARD)
        refined = refiner.refine(self.raw)
        means = _average_measures(list(refined))
        row = {
            f"{name}_ratio": means[name] / self.mocap[name]
            for name in ("contact_speed_cm_s", "jitter_m_s3")
            if self.mocap[name] > 0
        }
        if min(len(refined), len(self.windows)) >= self.settings.min_clips:
            made = [
                cut_windows(canonical_positions(decode(clip, GroundPose.origin())), self.settings.windows)
                for clip in refined
            ]
            seeded = torch.Generator().manual_seed(0)
            row["told_apart"] = compute_held_out_accuracy(
                made, self.windows, generator=seeded, settings=self.settings.classifier
            )
        return row


def sample_corpus(prior: LstmGmmDensity, corpus: Corpus, count: int, frames: int, generator: torch.Generator) -> Corpus:
    """Free runs of the density, each after two seconds of a clip; clips are drawn by their length.

    So the samples have the data's own shares of gaits and speeds, and the critic is left with their quality.
    """
    clips = [clip for clip in corpus.clips() if len(clip) >= _WARM_UP_FRAMES]
    lengths = torch.tensor([float(len(clip)) for clip in clips])
    picked = torch.multinomial(lengths, count, replacement=True, generator=generator).tolist()
    state = prior.start_after(torch.stack([clips[i][0] for i in picked]))
    state = prior.advance(state, torch.stack([clips[i][1:_WARM_UP_FRAMES] for i in picked]))
    features, _ = prior.sample(state, frames, generator)
    return Corpus(tuple(f"sample {k}" for k in range(count)), (frames,) * count, features.float().flatten(0, 1))


def compute_realism_gap(row: Mapping[str, float | None]) -> float:
    """Less is better: how far foot speed and jitter are from mocap's (log ratios), and the classifier's accuracy.

    Infinite where a measure cannot be had, as of feet that never touch the floor.
    """
    ratios = [value or math.nan for name, value in row.items() if name.endswith("_ratio")]
    if not all(value > 0 for value in ratios):
        return math.inf
    told = row.get("told_apart") or 0.0
    return sum(abs(math.log(value)) for value in ratios) + 2 * max(0.0, told - 0.5)


_NO_CARD = checkpoints.Card("refiner", {}, licence="", **checkpoints.Card.layout_fields())


def _average_measures(clips: list[Tensor]) -> dict[str, float]:
    rows = [measure(decode(clip, GroundPose.origin())) for clip in clips]
    return {name: float(torch.tensor([row[name] for row in rows]).nanmean()) for name in rows[0]}
