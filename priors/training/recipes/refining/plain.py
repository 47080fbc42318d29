"""Training of the plain peer of the refiner: the same network without a critic, held to moments and the hips' way."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import torch
from torch import Tensor

from mapctl.errors import RequestError
from priors.config import require_at_least
from priors.refiner.network import RefinerConfig, RefinerNetwork
from priors.training.adversaries.statistics import compute_statistics
from priors.training.corpus import Corpus, Split
from priors.training.moment_matching import moment_loss
from priors.training.quality.refiner import RefinerEvaluator
from priors.training.recipe import Row, average
from priors.training.recipes.refining.samples import REFINER_MOMENTS, SampleRecipe, compute_root_error
from priors.training.trainer import GradientTrainer
from priors.training.windows import FeatureWindows

_LEAST_WINDOW = 8  # frames that moments can be had of


@dataclass(frozen=True)
class PlainRefinerSettings:
    """How a plain refiner is trained."""

    rounds: int = 4000
    """Updates."""
    window: int = 48
    """Frames that are compared."""
    batch: int = 32
    """Windows an update."""
    learning_rate: float = 1e-4
    """Throughout."""
    root: float = 20.0
    """Weight of the squared distance between the roots' ways before and after, per m^2."""
    moments: float = 10.0
    """Weight of feet, jerk and spread as they are in captured windows (see moment_matching.moment_loss)."""
    bfloat16: bool = False
    """The network computes in bfloat16; weights and losses stay in float32."""
    seed: int = 1
    """Seed of weights, windows and samples."""

    def __post_init__(self):
        require_at_least(self, 1, "rounds", "batch")
        if self.window < _LEAST_WINDOW:
            raise RequestError(f"window must be at least {_LEAST_WINDOW} for moments to be compared, got {self.window}")


class PlainRefinerTrainer(GradientTrainer[RefinerNetwork]):
    """Draws samples and captured windows, and brings the moments of both nearer to each other."""

    def __init__(
        self,
        config: RefinerConfig,
        settings: PlainRefinerSettings,
        corpus: Corpus,
        raw: Corpus,
        evaluate: RefinerEvaluator | None = None,
    ):
        """`corpus` is captured, `raw` sampled from the density that is to be refined; `evaluate` measures a refiner."""
        self.settings, self.evaluate = settings, evaluate
        statistics = compute_statistics(corpus, config, settings.window)
        super().__init__(
            lambda: RefinerNetwork(config, **statistics),
            steps=settings.rounds,
            learning_rate=settings.learning_rate,
            seed=settings.seed,
        )
        self.captured = FeatureWindows(corpus, settings.window)
        self.raw = FeatureWindows(raw, settings.window + self.network.before + config.lookahead)

    def losses(self) -> dict[str, Tensor]:
        """Compute the losses of newly drawn windows."""
        settings, batch = self.settings, self.group.share(self.settings.batch)
        raw = self.raw.draw(batch, self.generator).features
        captured = self.captured.draw(batch, self.generator).features
        with torch.autocast("cpu", torch.bfloat16, enabled=settings.bfloat16):
            refined, _ = self.network(raw)
        refined = refined.float()
        root = compute_root_error(raw[:, self.network.before :], refined)
        moments = moment_loss(refined, captured, REFINER_MOMENTS)
        return {"loss": settings.root * root + settings.moments * moments, "moments": moments}

    def compute_learning_rate(self) -> float:
        """The same throughout: the length of a run need not be known."""
        return self.learning_rate

    def validate(self, corpus: Corpus) -> Row:
        """Measures of refined samples beside mocap's (see `RefinerEvaluator`, which holds validation clips)."""
        row = {} if self.evaluate is None else self.evaluate(self.network)
        self.network.train()
        return row


@dataclass(frozen=True)
class PlainRefinerRecipe(SampleRecipe[PlainRefinerSettings, PlainRefinerTrainer]):
    """What to train a plain refiner on, and how."""

    guards = ("loss",)
    config: RefinerConfig = field(default_factory=RefinerConfig)
    """The network."""
    settings: PlainRefinerSettings = field(default_factory=PlainRefinerSettings)
    """How it is trained."""

    def make_trainer(self, parts: Split) -> PlainRefinerTrainer:
        """With samples of the density, to train on and to be measured."""
        return PlainRefinerTrainer(self.config, self.settings, parts.train, *self.draw_samples(parts))

    def format_news(self, rows: Sequence[Row]) -> str:
        """One line on the losses of some rounds."""
        return f"loss {average(rows, 'loss'):.3f}, moments {average(rows, 'moments'):.3f}"

    def format_command(self) -> str:
        """What to type for the same run, for the card; options that are the defaults are left out."""
        parts = self.format_begin()
        parts += self.format_changed(PlainRefinerSettings(), "batch", "window", "seed", rounds="steps")
        parts += ["--bfloat16"] * self.settings.bfloat16 + ["--plain"]
        return " ".join(parts + self.format_processes() + self.format_ending())
