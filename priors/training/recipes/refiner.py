"""Adversarial training of the refiner: Wang et al. 2019, sections 4.2.1 and 4.2.2, with departures."""

import math
from collections.abc import Callable, Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass
from functools import cached_property
from typing import Annotated

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.functional import binary_cross_entropy_with_logits as cross_entropy

from mapctl.features import LAYOUT, PRIOR_FPS, GroundPose, integrate_root
from mapctl.metrics import measure
from mapctl.metrics.realism import WINDOW_FRAMES, RealismSettings, compute_held_out_accuracy, cut_windows
from mapctl.pose import decode
from priors import checkpoints
from priors.checkpoints import require_at_least
from priors.lstm_gmm.density import LstmGmmDensity
from priors.refiner import PAPER, LstmRefiner, RefinerConfig, RefinerNetwork, compute_end_effectors
from priors.training.critics import WINDOW_MOMENTS, EndEffectorCritic, HistoryBuffer, moment_loss
from priors.training.data import Corpus, Split, compute_feature_statistics, find_window_starts
from priors.training.loop import (
    Count,
    Export,
    InPython,
    Name,
    Pattern,
    Row,
    Settings,
    Trainer,
    draw_weights,
    update_average,
)
from priors.training.windows import FeatureWindows

_MIN_MOMENT_FRAMES = 8  # frames of a window that moments can be had of
_CRITIC_WON = 0.98  # share that the critic classifies correctly, over a report, from which it has won
_BETAS = (0.5, 0.9)
_WARM_UP_FRAMES = 60  # frames of a clip that condition the density before it runs freely
_SAMPLES, _SECONDS = 300, 10.0  # motions drawn from the density to train on, and the duration of each, s
_JUDGED = 24  # motions drawn to be measured
_WARM_UP = 75  # updates of each before the rounds (section 4.2.2)
# Updates of the critic before anything else (the paper's 0): a refiner led by a critic that has learnt nothing harms
# samples that were nearly good.
_HEAD_START = 200
_CRITIC_UPDATES = 2  # updates of the critic in each round (the paper's 1)
_REFINER_UPDATES = 1  # initial updates of the refiner in each round (the paper's 5); doubled and halved as either wins
_STRONG, _WEAK = 0.01, 1.0  # critic's loss below which the refiner's updates are doubled, and above which halved
_MOST_UPDATES = 20  # they are never more than this
_HISTORY = 320  # refined windows kept for the critic
_ROOT = 20.0  # weight of the squared distance between the root trajectories before and after (Eq. 13), per m^2
_REFINER_RATE, _CRITIC_RATE = 1e-4, 5e-4  # learning rates (the paper's 0.002 and 0.005)
_MOMENTS = 10.0  # weight of feet, jerk and spread: the critic alone lets feet slide while it is still learning
_AVERAGE = 0.99  # share of the past in the running mean of the refiner's weights, which is what is kept


@dataclass(frozen=True, kw_only=True)
class RefinerSettings(Settings):
    """Train a refiner, which makes a density's samples look captured; a step is a round of updates of the refiner and
    its critic. The best refiner by held-out samples is kept, and training stops where one side wins."""

    kind = "refiner"
    used_by = "use it with --refiner"
    keeps_best = True

    match: Pattern = None
    """Only clips whose path below the data folder holds this regular expression; by default the clips that the density
    was trained on."""
    steps: Count = 4000
    """Rounds after the warm-up: some updates of the refiner, then some of the critic."""
    batch: Count = 32
    """Windows a step."""
    window: Count = 48
    """Frames a window."""
    density: Name = "locomotion"
    """The prior whose samples it refines."""
    paper: bool = False
    """The network of Wang et al. 2019; other options still hold."""
    report_steps: Annotated[int, *InPython] = 50
    """Rounds of whose losses the log holds the means."""
    validate_steps: Annotated[int, *InPython] = 300
    """Rounds between measures of held-out samples."""
    shape: Annotated[RefinerConfig | None, *InPython] = None
    """Shape of the network, in place of ours and the paper's."""

    def __post_init__(self):
        super().__post_init__()
        require_at_least(self, 2, "batch")
        require_at_least(self, _MIN_MOMENT_FRAMES, "window")

    @property
    def config(self) -> RefinerConfig:
        """Shape of the network."""
        return self.shape or (PAPER if self.paper else RefinerConfig())

    @cached_property
    def prior(self) -> LstmGmmDensity:
        """The density, loaded."""
        return LstmGmmDensity.load(self.density)

    @property
    def chosen(self) -> str:
        return self.prior.card.data.get("match", "") if self.match is None else self.match

    @property
    def split_seed(self) -> int:
        """Seed of the density's split, so that its held-out clips stay held out."""
        return self.prior.card.data.get("split_seed", self.seed)

    def make_trainer(self, parts: Split) -> "AdversarialTrainer":
        """Make the trainer with samples of the density, to train on and to be measured."""
        raw, measured = self.sample(parts)
        return AdversarialTrainer(self, parts.train, raw, make_evaluator(measured, parts.validation))

    def sample(self, parts: Split) -> tuple[Corpus, Corpus]:
        """Sample motions to train on, and others to measure."""
        generator, frames = torch.Generator().manual_seed(self.seed), round(_SECONDS * PRIOR_FPS)
        first, second = (
            sample_corpus(self.prior, parts.train, count, frames, generator) for count in (_SAMPLES, _JUDGED)
        )
        return first, second


class AdversarialTrainer(Trainer[RefinerNetwork]):
    """Refiner, critic and history, one round at a time. What is kept is the running mean of the refiner's weights."""

    def __init__(
        self, settings: RefinerSettings, corpus: Corpus, raw: Corpus, evaluate: Callable[[RefinerNetwork], Row]
    ):
        """`corpus` is captured, `raw` sampled from the density that is to be refined; `evaluate` measures a refiner."""
        super().__init__(settings)
        self.config, self.updates, self.evaluate = settings.config, _REFINER_UPDATES, evaluate
        statistics = compute_statistics(corpus, self.config, settings.window)
        reach = {name: statistics[name] for name in ("reach_mean", "reach_std")}
        self.refiner, self.critic = draw_weights(
            lambda: (RefinerNetwork(self.config, **statistics), EndEffectorCritic(self.config.joints, **reach)),
            settings.seed,
        )
        self.network = deepcopy(self.refiner).requires_grad_(False)
        self.captured = FeatureWindows(corpus, settings.window)
        self.raw = FeatureWindows(raw, settings.window + self.refiner.before + self.config.lookahead)
        self.refiner_optimiser = torch.optim.Adam(self.refiner.parameters(), lr=_REFINER_RATE, betas=_BETAS)
        self.critic_optimiser = torch.optim.Adam(self.critic.parameters(), lr=_CRITIC_RATE, betas=_BETAS)
        count = max(_HISTORY, settings.batch)
        with torch.no_grad():
            first = [self.refiner(self._draw(self.raw))[0] for _ in range(-(-count // settings.batch))]
        self.history = HistoryBuffer(torch.cat(first)[:count])

    def networks(self) -> dict[str, nn.Module]:
        return {"averaged": self.network, "refiner": self.refiner, "critic": self.critic}

    def optimisers(self) -> dict[str, torch.optim.Optimizer]:
        return {"refiner-optimiser": self.refiner_optimiser, "critic-optimiser": self.critic_optimiser}

    def warm_up(self) -> None:
        """Before the rounds: the critic alone, then both."""
        for _ in range(_HEAD_START):
            self._criticise()
        for _ in range(_WARM_UP):
            self._refine()
            self._criticise()

    def train_step(self) -> dict[str, float]:
        """Updates of the refiner, then of the critic, and the balance of section 4.2.2.

        Return the mean of Eq. 9 and half of Eq. 10 in nats, where 0.69 is a critic that has learnt nothing; the share
        of its batch that the critic classified correctly; and how often the refiner was updated.
        """
        if self.step == 0:
            self.warm_up()
        updates = self.updates
        refiner = sum(self._refine() for _ in range(updates)) / updates
        judged = [self._criticise() for _ in range(_CRITIC_UPDATES)]
        critic, accuracy = (sum(each) / _CRITIC_UPDATES for each in zip(*judged, strict=True))
        if critic < _STRONG:
            self.updates = min(2 * updates, _MOST_UPDATES)
        elif critic > _WEAK:
            self.updates = max(1, updates // 2)
        self.step += 1
        return {"refiner": refiner, "critic": critic, "accuracy": accuracy, "updates": updates}

    def validate(self, corpus: Corpus) -> Row:
        """Measure refined samples beside mocap's (see `make_evaluator`, which has the validation clips)."""
        return self.evaluate(self.network)

    def state(self) -> dict[str, Tensor]:
        updates = torch.tensor(self.updates)
        return {**super().state(), "history": self.history.windows, "updates": updates}

    def load_state(self, tensors: Mapping[str, Tensor], step: int) -> None:
        super().load_state(tensors, step)
        self.history = HistoryBuffer(tensors["history"])
        self.updates = int(tensors["updates"])

    def _refine(self) -> float:
        """One update of the refiner (Eq. 13), and of its running mean."""
        raw = self._draw(self.raw)
        refined, _ = self.refiner(raw)
        odds = self.critic(refined)
        loss = cross_entropy(odds, torch.ones(odds.shape))
        total = loss + _ROOT * compute_root_error(raw[:, self.refiner.before :], refined)
        total = total + _MOMENTS * moment_loss(refined, self._draw(self.captured), WINDOW_MOMENTS)
        self._step(self.refiner_optimiser, self.refiner, total)
        update_average(self.network, self.refiner, _AVERAGE)
        return float(loss.detach())

    def _criticise(self) -> tuple[float, float]:
        """One update of the critic (Eq. 10) on captured windows, fresh refined ones and kept ones."""
        with torch.no_grad():
            fresh, _ = self.refiner(self._draw(self.raw))
        half = len(fresh) // 2
        generated = torch.cat([fresh[half:], self.history.draw(half, self.generator)])
        self.history.keep(fresh[:half], self.generator)
        odds = self.critic(torch.cat([self._draw(self.captured), generated]))
        truth = torch.cat([torch.ones(len(odds) - len(generated)), torch.zeros(len(generated))])
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

    def _draw(self, windows: FeatureWindows) -> Float[Tensor, "batch frames size"]:
        return windows.draw(self.settings.batch, self.generator).features

    def score(self, row: Row) -> float:
        """Return how far foot speed, jitter and classifier accuracy are from mocap's."""
        return compute_realism_gap(row)

    def find_stop_reason(self, rows: Sequence[Row]) -> str | None:
        """Stop where a loss is not finite, or the critic has classified nearly all correctly since the last report."""
        if not all(math.isfinite(rows[-1][name]) for name in ("refiner", "critic")):
            return f"training diverged at step {self.step}"
        if len(rows) >= self.settings.report_steps and sum(row["accuracy"] for row in rows) / len(rows) > _CRITIC_WON:
            return "the critic has won"
        return None

    def export(self, parts: Split) -> Export:
        """Return the best refiner so far, measured on the test clips, by which none was chosen."""
        settings, evaluate = self.settings, make_evaluator(self.settings.sample(parts)[1], parts.test)
        # Feet that never touch the floor have no speed there, and a card holds no other numbers than finite ones.
        test = {name: value if math.isfinite(value) else None for name, value in evaluate(self.network).items()}
        data = {
            "density": settings.density,
            "density_config": settings.prior.reference.config.as_card(),
            "samples": _SAMPLES,
        }
        return Export(self.network.state_dict(), data, {"test": test})


def compute_root_error(before: Tensor, after: Tensor) -> Tensor:
    """Mean squared distance of root trajectories and heights (Wang et al. 2019, Eq. 13), m^2; `before` may go on."""
    before = before[:, : after.shape[1]]
    origin = GroundPose(before.new_zeros(len(before), 2), before.new_zeros(len(before)))
    ground = integrate_root(before, origin)[0] - integrate_root(after, origin)[0]
    height = LAYOUT.pick(before, "root_height") - LAYOUT.pick(after, "root_height")
    return (ground.square().sum(-1) + height[..., 0].square()).mean()


def compute_statistics(corpus: Corpus, config: RefinerConfig, window: int) -> dict[str, Tensor]:
    """Mean and spread of features and end effectors over captured clips, with floors that keep held joints in hand."""
    features = corpus.features
    mean, std = compute_feature_statistics(features)
    starts = find_window_starts(corpus.lengths, window)[:: max(1, window)]
    reach = torch.cat(
        [
            compute_end_effectors(features[rows[:, None] + torch.arange(window)], config.joints).flatten(0, 1)
            for rows in starts.split(512)
        ]
    )
    return {"mean": mean, "std": std, "reach_mean": reach.mean(0), "reach_std": reach.std(0).clamp(min=0.01)}


def make_evaluator(raw: Corpus, held: Corpus) -> Callable[[RefinerNetwork], dict[str, float]]:
    """Make the measurement of a refiner by samples that it refines anew each time, beside clips that training does not
    see: contact speed and jitter as ratios to mocap's, and the accuracy of a classifier of both."""
    clips, settings = [clip for clip in held.clips() if len(clip) > WINDOW_FRAMES], RealismSettings()
    mocap, windows, samples = _average_measures(clips), _cut_clips(clips), torch.stack(raw.clips())

    def evaluate(network: RefinerNetwork) -> dict[str, float]:
        refined = list(LstmRefiner("in training", network.eval(), _NO_CARD).refine(samples))
        means, measured = _average_measures(refined), ("contact_speed_cm_s", "jitter_m_s3")
        row = {f"{name}_ratio": means[name] / mocap[name] for name in measured if mocap[name] > 0}
        if min(len(refined), len(windows)) >= settings.min_clips:
            seeded = torch.Generator().manual_seed(0)
            row["classifier_accuracy"] = compute_held_out_accuracy(
                _cut_clips(refined), windows, generator=seeded, settings=settings
            )
        return row

    return evaluate


def _cut_clips(clips: list[Tensor]) -> list[Tensor]:
    return [cut_windows(decode(clip, GroundPose.origin())) for clip in clips]


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
    accuracy = row.get("classifier_accuracy") or 0.0
    return sum(abs(math.log(value)) for value in ratios) + 2 * max(0.0, accuracy - 0.5)


_NO_CARD = checkpoints.Card("refiner", {}, licence="")


def _average_measures(clips: list[Tensor]) -> dict[str, float]:
    rows = [measure(decode(clip, GroundPose.origin())) for clip in clips]
    return {name: float(torch.tensor([row[name] for row in rows]).nanmean()) for name in rows[0]}
