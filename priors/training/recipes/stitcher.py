"""Training of the stitcher: both ways between two poses of mocap, longer and longer ones."""

import copy
from collections.abc import Sequence
from dataclasses import astuple, dataclass, field, replace
from typing import Any

import torch
from torch import Tensor, nn

from mapctl.errors import RequestError
from mapctl.features import LAYOUT, mirror_features
from priors.config import require_at_least
from priors.stitching.layers import multiply_in_bfloat16
from priors.stitching.network import StitcherConfig, StitcherNetwork
from priors.stitching.posterior import PosteriorNetwork
from priors.training.augmentation.transition_windows import Known, TransitionWindows
from priors.training.corpus import Corpus, Split
from priors.training.quality.stitcher import calibrate_temperature, measure_transitions
from priors.training.recipe import Export, Gathered, NetworkRecipe, Row, average_logarithms
from priors.training.recipes.stitcher_losses import LossWeights, Shares, find_stitcher_losses
from priors.training.trainer import GradientTrainer

_SHORTEST, _FIRST_LONGEST = 2, 8  # frames from pose to pose
_LEAST_WINDOW = 16  # frames of the longest transition
_CONTEXT = 10  # frames told before or after, at most
_LENGTH_GROWTH = 0.5  # share of training in which transitions become longer
_AVERAGE = 0.999
_LEAST_SPREAD = 0.05  # of a feature, of the typical one of its block


@dataclass(frozen=True)
class StitcherSettings:
    """How a stitcher is trained."""

    steps: int = 12_000
    """Updates."""
    batch: int = 64
    """Transitions an update, all of one length."""
    window: int = 61
    """Frames from one pose to the other in the longest."""
    learning_rate: float = 1e-3
    """At its highest; it falls to nothing along a cosine."""
    shares: Shares = field(default_factory=Shares)
    """Where the transitions' latents come from."""
    weights: LossWeights = field(default_factory=LossWeights)
    """Of what is learnt."""
    evenness: float = 0.85
    """How evenly windows are drawn from kinds of clips: 0 by their frames, 1 the same number from each."""
    kinds: tuple[str, ...] = ("walk-turn", "walk", "run|dash", "^cmu")
    """Kinds, as patterns of names; clips of none of these are another kind."""
    bfloat16: bool = False
    """Layers multiply in bfloat16; weights, all else and the loss stay in float32."""
    seed: int = 1
    """Seed of weights, windows and latents."""

    def __post_init__(self):
        require_at_least(self, 1, "steps", "batch")
        if self.window < _LEAST_WINDOW:
            raise RequestError(f"window must be at least {_LEAST_WINDOW} frames, got {self.window}")
        shares = astuple(self.shares)
        if min(shares) < 0 or not 0 < sum(shares) <= 1:
            raise RequestError("shares of a batch are 0 to 1 together, and more than nothing")


class StitcherTrainer(GradientTrainer[StitcherNetwork]):
    """Draws transitions, hides what is between their ends, and brings both sides nearer to it."""

    def __init__(self, config: StitcherConfig, settings: StitcherSettings, corpus: Corpus):
        self.windows = TransitionWindows(corpus, kinds=settings.kinds, evenness=settings.evenness)
        self.longest = min(config.longest, settings.window, max(corpus.lengths) - 2 * _CONTEXT - 1)
        if self.longest < _SHORTEST:
            raise RequestError(f"a stitcher needs clips of {_SHORTEST + 2 * _CONTEXT + 1} frames and more")
        device = torch.get_default_device()
        super().__init__(lambda: self._make(config, device), settings)
        _set_moments(self.network, corpus)
        self.average = copy.deepcopy(self.network).requires_grad_(False)
        """Moving average of the weights: what is measured and exported."""

    def _make(self, config: StitcherConfig, device: torch.device) -> StitcherNetwork:
        network = StitcherNetwork(config)
        self.posterior = PosteriorNetwork(config).to(device)
        """Sees the truth."""
        return network

    def make_optimisers(self) -> dict[str, torch.optim.Optimizer]:
        """AdamW with a short memory."""
        return {"optimiser": torch.optim.AdamW(self.weights(), lr=self.learning_rate, betas=(0.5, 0.9))}

    def weights(self) -> list[nn.Parameter]:
        """Those of the posterior too."""
        return [*super().weights(), *self.posterior.parameters()]

    def networks(self) -> dict[str, nn.Module]:
        """All that is learnt, by its name in checkpoints."""
        return super().networks() | {"posterior": self.posterior, "average": self.average}

    @property
    def exported(self) -> StitcherNetwork:
        """The moving average of the weights."""
        return self.average

    def losses(self) -> dict[str, Tensor]:
        """Compute the losses of a newly drawn batch."""
        settings = self.settings
        longest = _FIRST_LONGEST + max(0, self.longest - _FIRST_LONGEST) * min(1.0, self.progress / _LENGTH_GROWTH)
        longest = max(_SHORTEST, min(round(longest), self.longest))
        frames = int(torch.randint(_SHORTEST, longest + 1, (), generator=self.generator))
        truth = self.windows.draw(settings.batch, frames, _draw_known(self.generator), self.generator)
        with multiply_in_bfloat16(self.network, self.posterior, wanted=settings.bfloat16):
            parts, errors = find_stitcher_losses(
                self.network, self.posterior, truth, settings.shares, settings.weights.ease, self.generator
            )
        return {"loss": settings.weights.weigh(parts), **errors}

    def train_step(self) -> dict[str, float]:
        """Take one update, and bring the average nearer."""
        parts = super().train_step()
        keep = min(_AVERAGE, (1 + self.step) / (10 + self.step))
        with torch.no_grad():
            for mean, weight in zip(self.average.parameters(), self.network.parameters(), strict=True):
                mean.lerp_(weight, 1 - keep)
        return parts

    @torch.no_grad()
    def validate(self, corpus: Corpus) -> dict[str, Any]:
        """Measure transitions of unseen clips."""
        windows = TransitionWindows(corpus, kinds=self.settings.kinds, evenness=1.0)
        return measure_transitions(self.average, windows)


def _draw_known(generator: torch.Generator) -> Known:
    """Two bare poses in two fifths of the cases; in the rest up to 10 frames before, and after or not."""
    share = float(torch.rand((), generator=generator))
    before, after = torch.randint(0, _CONTEXT + 1, (2,), generator=generator).tolist()
    if share < 0.4:
        return Known()
    if share < 0.55:
        return Known(1, min(1, after))
    return Known(max(1, before) if share < 0.75 else _CONTEXT, after if share < 0.8 else 0)


@dataclass(frozen=True)
class StitcherRecipe(NetworkRecipe[StitcherConfig, StitcherSettings, StitcherTrainer]):
    """What to train a stitcher on, and how."""

    kind = "stitcher"
    trainer_class = StitcherTrainer
    config: StitcherConfig = field(default_factory=StitcherConfig)
    """The networks."""
    settings: StitcherSettings = field(default_factory=StitcherSettings)
    """How they are trained."""

    def make_trainer(self, parts: Split) -> StitcherTrainer:
        """As it is before the first step."""
        trainer = super().make_trainer(parts)
        trainer.average.load_state_dict(trainer.network.state_dict())
        return trainer

    def export(self, trainer: StitcherTrainer, gathered: Gathered, curve: Sequence[Row]) -> Export:
        """What is written at the end: the average of the weights, and how wide its draws are."""
        windows = TransitionWindows(gathered.parts.validation, kinds=self.settings.kinds, evenness=1.0)
        trainer.average.temperature.fill_(calibrate_temperature(trainer.average, windows))
        return replace(super().export(trainer, gathered, curve), tensors=trainer.average.state_dict())

    def score(self, row: Row) -> float:
        """Error of the calm answer to unseen transitions over the interpolation's, geometric mean over lengths, after a
        pose and after ten frames."""
        return average_logarithms(value for name, value in row.items() if name.startswith(("bare_", "past_")))


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
