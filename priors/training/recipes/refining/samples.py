"""What every training of a refiner has in common: samples of a density to refine, and how refiners are judged."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TypeVar

import torch
from torch import Tensor

from mapctl.features import LAYOUT, PRIOR_FPS, GroundPose, integrate_root
from mapctl.metrics.realism import RealismSettings
from priors.lstm_gmm import density
from priors.lstm_gmm.density import LstmGmmDensity
from priors.refiner.network import RefinerConfig, RefinerNetwork
from priors.training.corpus import Corpus, Split
from priors.training.gathering import DataSource, describe_selection
from priors.training.moment_matching import MatchingSettings
from priors.training.quality.refiner import RefinerEvaluator, compute_realism_gap, sample_corpus
from priors.training.recipe import Export, Gathered, Recipe, Row, Settings
from priors.training.trainer import Trainer

REFINER_MOMENTS = MatchingSettings(feet=0.25, jerk=2.0, pace=0.0, spread=0.5, drift=0.0)
"""That a refiner is held to, as pieces of a window show them."""

S = TypeVar("S", bound=Settings)
T = TypeVar("T", bound=Trainer[RefinerNetwork])


@dataclass(frozen=True)
class SampleRecipe(Recipe[RefinerConfig, S, T]):
    """What to train a refiner on, however it is trained. The best refiner seen is kept."""

    kind = "refiner"
    falls = False
    uses_gpu = False
    headline = "distance from mocap"
    counter = "round"
    steps_name = "rounds"
    match: str | None = None
    """Regular expression for the clips; the density's own if None."""
    report_steps: int = 50
    """Rounds between lines of news."""
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

    def source(self) -> DataSource:
        """Gather the data, split as the density's, so that its held-out clips stay held out."""
        return replace(super().source(), match=self._find_match())

    def list_teachers(self) -> tuple[str, ...]:
        """Models that the weights begin with or learn from, bundled or trained."""
        return (*super().list_teachers(), self.density)

    @property
    def split_seed(self) -> int:
        """That of the density, so that its held-out clips stay held out."""
        return self.prior.card.data.get("split_seed", self.settings.seed)

    def draw_samples(self, parts: Split) -> tuple[Corpus, RefinerEvaluator]:
        """Samples of the density to train on, and what chooses a refiner by others, beside the validation clips."""
        raw, measured = self._sample(parts)
        return raw, RefinerEvaluator.of(measured, parts.validation, self.realism)

    def _sample(self, parts: Split) -> tuple[Corpus, Corpus]:
        """Samples to train on, and others to measure."""
        generator, frames = torch.Generator().manual_seed(self.settings.seed), round(self.seconds * PRIOR_FPS)
        first, second = (
            sample_corpus(self.prior, parts.train, count, frames, generator) for count in (self.samples, self.judged)
        )
        return first, second

    def describe_data(self, corpus: Corpus) -> dict[str, str]:
        """What tells the data of this run from others'."""
        return corpus.identity() | {"density": self.density, "match": self._find_match()}

    def score(self, row: Row) -> float:
        """Measure how far foot speed, jitter and classifier accuracy are from mocap's."""
        return compute_realism_gap(row)

    @classmethod
    def find_headline(cls, row: Row) -> float:
        """What the best is chosen by (see `compute_realism_gap`)."""
        return compute_realism_gap(row)

    def export(self, trainer: T, gathered: Gathered, curve: Sequence[Row]) -> Export:
        """Return the best refiner so far, measured on the test clips, by which none was chosen."""
        data = {
            "density_config": self.prior.reference.config.as_card(),
            "samples": self.samples,
            **self.describe_data(gathered.corpus),
            **describe_selection(gathered.corpus),
        }
        best = min(curve, key=compute_realism_gap)
        judge = RefinerEvaluator.of(self._sample(gathered.parts)[1], gathered.parts.test, self.realism)
        # Feet that never touch the floor have no speed there, and a card holds no other numbers than finite ones.
        test = {name: value if math.isfinite(value) else None for name, value in judge(trainer.network).items()}
        quality = {self.counter: best[self.counter], "test": test}
        return Export(trainer.network.state_dict(), data, quality)

    def format_begin(self) -> list[str]:
        """What a card's command begins with: the data and the density."""
        parts = [f"mapctl train refiner --data DATA -o RUN --density {self.density}"]
        parts += [f"--match '{self.match}'"] if self.match is not None else []
        return parts + self.format_reading()

    def _find_match(self) -> str:
        return self.prior.card.data.get("match", "") if self.match is None else self.match


def compute_root_error(before: Tensor, after: Tensor) -> Tensor:
    """Mean squared distance of the roots' ways and heights (Wang et al. 2019, Eq. 13), m^2; `before` may go on
    longer."""
    before = before[:, : after.shape[1]]
    origin = GroundPose(before.new_zeros(len(before), 2), before.new_zeros(len(before)))
    ground = integrate_root(before, origin)[0] - integrate_root(after, origin)[0]
    height = LAYOUT.pick(before, "root_height") - LAYOUT.pick(after, "root_height")
    return (ground.square().sum(-1) + height[..., 0].square()).mean()
