"""Training of the generator of long in-betweens by distances (Zhou et al. 2020, sections 3.4 to 3.6, appendix C).

Part of each batch are windows of one clip, whose truth is known; the others (`TweenerSettings.spliced`) are spliced of
several, of which only keys and style are. What lies between keys of different clips is held by what the generator
learnt in windows of one, and by critics only where a run asks for them (`--critic-from`).
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import torch
from torch import Tensor

from mapctl import kinematics
from mapctl.errors import RequestError
from mapctl.inbetweening.position_image import mirror_positions
from mapctl.metrics.liveliness import see_from_hips
from mapctl.skeleton import CANONICAL
from priors import checkpoints
from priors.config import require_at_least
from priors.training.augmentation.key_layouts import KeySequences, KeySettings, draw_splices, draw_windows
from priors.training.augmentation.key_parts import WHOLE
from priors.training.augmentation.pose_windows import PoseWindows
from priors.training.augmentation.style_poses import draw_style_poses
from priors.training.corpus import Corpus, Split
from priors.training.devices import make_generator
from priors.training.quality.gap import measure_kinds
from priors.training.recipe import Export, Gathered, NetworkRecipe, Row, average_logarithms
from priors.training.recipes.tweener_losses import Judge, LossWeights, compute_tweener_losses
from priors.training.trainer import GradientTrainer
from priors.tweening import generator
from priors.tweening import path as path_predictor
from priors.tweening.class_vectors import compute_classes, group_clips
from priors.tweening.generator import GeneratorConfig, GeneratorNetwork
from priors.tweening.path import PathNetwork
from priors.tweening.styles import LABELS, find_class

_SHORTEST_WINDOW, _LEAST_WINDOW = 64, 32  # frames
_MIN_STD = 0.05  # metres
_FOREIGN_STYLES = 0.7  # share of styles of spliced sequences that are of another clip


@dataclass(frozen=True)
class TweenerSettings:
    """How the generator is trained."""

    steps: int = 16_000
    """Updates."""
    batch: int = 8192
    """Frames an update."""
    spliced: float = 0.25
    """Share of them in sequences that are spliced of several clips; the others are in windows of one."""
    window: int = 330
    """Frames of the longest window of one clip; of those the shortest have 64."""
    splice: tuple[int, int] = (192, 1024)
    """Frames of the shortest and the longest sequence that is spliced."""
    optimiser: str = "adam"
    """`adam`, or the paper's `rmsprop`, whose learning rate does not fall."""
    root_growth: float = 0.0
    """What each 1,000 steps add to the weight of the way from key to key, up to eight times its beginning."""
    learning_rate: float = 1e-3
    """At its highest; it falls to nothing along a cosine."""
    weights: LossWeights = field(default_factory=LossWeights)
    """What each error counts."""
    styled: float = 0.35
    """Share of sequences that are given a style: of windows poses that are in them, of what is spliced poses in it or,
    more often, of another clip altogether."""
    tempo: float = 0.15
    """Largest change of tempo of windows of one clip, as a share."""
    layout: KeySettings = field(default_factory=KeySettings)
    """Where keys lie."""
    evenness: float = 1.0
    """How evenly clips are drawn from their kinds: 0 by their frames, 1 the same number from each."""
    kinds: tuple[str, ...] = ("walk-turn", "walk", "run|dash", "^cmu")
    """Kinds, as patterns of names; clips of none of these are another kind."""
    bfloat16: bool = False
    """Both networks compute in bfloat16; weights and losses stay in float32."""
    seed: int = 1
    """Seed of weights, windows and keys."""

    def __post_init__(self):
        require_at_least(self, 1, "steps", "batch")
        require_at_least(self, _LEAST_WINDOW, "window")
        if self.optimiser not in ("adam", "rmsprop"):
            raise RequestError(f"optimiser must be adam or rmsprop, got {self.optimiser!r}")


PAPER = (
    generator.PAPER,
    TweenerSettings(
        steps=560_000,
        batch=4 * 2048,
        spliced=1.0,
        splice=(2048, 2048),
        optimiser="rmsprop",
        learning_rate=1e-5,
        styled=1.0,
        root_growth=1.0,
        weights=LossWeights(
            places=0.0,
            pace=0.0,
            activity=0.0,
            turns=0.0,
            keys=300.0,
            feet=0.0,
            contacts=0.0,
            path=0.0,
            root=10.0,
            style=50.0,
            dwell=50.0,
            regularisation=5.0,
            squares=True,
        ),
        layout=KeySettings(longest=300.0, first_longest=300.0, shortest=300.0, runs=0.0, open_ends=0.0, parts=WHOLE),
    ),
)
"""The variant as the paper prints it: section 3.6, table 5 and appendix C, at 30 frames a second."""


class TweenerTrainer(GradientTrainer[GeneratorNetwork]):
    """Draws sequences, hides all but their keys, and brings the generator nearer to what was between."""

    def __init__(self, config: GeneratorConfig, settings: TweenerSettings, corpus: Corpus, path: PathNetwork):
        self.settings, self.path = settings, path.to(torch.get_default_device())
        self.grown = False
        """Whether gaps are as long as they get from the first step on."""
        self.shortest = _SHORTEST_WINDOW
        """Frames of the shortest window of one clip."""
        self.windows = PoseWindows(corpus, kinds=settings.kinds, evenness=settings.evenness)
        fits = int(int(self.windows.lengths.max()) / (1 + settings.tempo)) - 1
        self.longest = min(settings.window, fits)
        super().__init__(
            lambda: GeneratorNetwork(config, bfloat16=settings.bfloat16),
            steps=settings.steps,
            learning_rate=settings.learning_rate,
            seed=settings.seed,
        )
        _set_moments(self.network, self.windows)

    def make_optimisers(self) -> dict[str, torch.optim.Optimizer]:
        """Adam with the short memory that pays where the data change from step to step."""
        weights, rate = self.network.parameters(), self.learning_rate
        if self.settings.optimiser == "rmsprop":
            return {"optimiser": torch.optim.RMSprop(weights, lr=rate)}
        return {"optimiser": torch.optim.Adam(weights, lr=rate, betas=(0.5, 0.9))}

    def compute_learning_rate(self) -> float:
        """At the current step."""
        return self.learning_rate if self.settings.optimiser == "rmsprop" else super().compute_learning_rate()

    def losses(self) -> dict[str, Tensor]:
        """Compute the losses of a newly drawn batch."""
        weights = self.settings.weights
        growth = self.settings.root_growth * (self.step // 1000)
        return self.compute_losses(replace(weights, root=min(weights.root + growth, 8 * weights.root)))

    def compute_losses(self, weights: LossWeights, judge: Judge | None = None) -> dict[str, Tensor]:
        """Compute the losses of a newly drawn batch at these weights; a `judge` adds to both its halves'."""
        settings = self.settings
        progress = 1.0 if self.grown else self.step / self.first_steps
        reach = round(1.25 * settings.layout.longest_at(progress))
        shortest = min(self.shortest, self.longest)
        frames = self._draw_frames(shortest, min(self.longest, shortest + reach))
        one = draw_windows(
            self.windows,
            self.group.share(max(1, round((1 - settings.spliced) * settings.batch / frames))),
            frames,
            settings.layout,
            progress=progress,
            tempo=settings.tempo,
            generator=self.generator,
        )
        frames = self._draw_frames(*settings.splice)
        batch = self.group.share(max(1, round(settings.spliced * settings.batch / frames)))
        other = draw_splices(self.windows, batch, frames, settings.layout, progress=progress, generator=self.generator)
        parts, spliced = (
            self._compare(sequences, foreign, weights, judge)
            for sequences, foreign in ((one, 0.0), (other, _FOREIGN_STYLES))
        )
        parts["loss"] = parts["loss"] + spliced["loss"]
        return parts | {f"spliced_{name}": spliced[name] for name in ("keys_cm", "root_cm", "style_cm", "dwell_cm")}

    def _draw_frames(self, shortest: int, longest: int) -> int:
        share = float(torch.rand((), generator=self.common))
        return round(shortest * (max(shortest, longest) / shortest) ** share)

    def _compare(
        self, sequences: KeySequences, foreign: float, weights: LossWeights, judge: Judge | None
    ) -> dict[str, Tensor]:
        poses = draw_style_poses(self.windows, sequences, foreign, self.generator)
        styled = torch.rand(len(poses), generator=self.generator) < self.settings.styled
        return compute_tweener_losses(self.network, self.path, sequences, poses, styled, weights, judge)

    def validate(self, corpus: Corpus) -> dict[str, Any]:
        """Measure gaps of unseen clips (see `measure_kinds`)."""
        return measure_kinds(self.network, corpus, self.settings.kinds)


@dataclass(frozen=True)
class TweenerRecipe(NetworkRecipe[GeneratorConfig, TweenerSettings, TweenerTrainer]):
    """What to train the generator on, and how."""

    kind = "tweener"
    headline = "error over slerp's"
    config: GeneratorConfig = field(default_factory=GeneratorConfig)
    """The network."""
    settings: TweenerSettings = field(default_factory=TweenerSettings)
    """How it is trained."""
    path: str = "path"
    """The path predictor that sees where the hips go, bundled or trained."""
    labels: str = LABELS
    """Regular expression whose first group in a clip's name is its class, whose style the card tells."""

    def check(self) -> None:
        """Before anything is read."""
        super().check()
        find_class("", self.labels)
        path_predictor.load(self.path)

    def list_teachers(self) -> tuple[str, ...]:
        """Models that the weights begin with or learn from, bundled or trained."""
        return (*super().list_teachers(), self.path)

    def make_untaught(self, parts: Split) -> TweenerTrainer:
        """The trainer, its weights drawn."""
        group_clips(parts.train.names, self.labels)  # what the end of training needs
        network = path_predictor.load(self.path).network
        network.reduced_precision = self.settings.bfloat16
        trainer = TweenerTrainer(self.config, self.settings, parts.train, network)
        # Who begins with weights of a run has seen them grow.
        trainer.grown = self.init is not None
        return trainer

    @classmethod
    def find_headline(cls, row: Row) -> float:
        """Error of unseen gaps over slerp's, geometric mean over kinds of clips."""
        kinds = [name.removesuffix("_slerp_cm") for name, value in row.items() if name.endswith("_slerp_cm") and value]
        pairs = [(row.get(f"{kind}_error_cm"), row[f"{kind}_slerp_cm"]) for kind in kinds if "before_" not in kind]
        return average_logarithms(error / slerp for error, slerp in pairs if error is not None)

    def pin(self, trainer: TweenerTrainer, corpus: Corpus) -> dict[str, Row]:
        """What must not change between a run's parts."""
        return {**super().pin(trainer, corpus), "path": {"hash": checkpoints.compute_hash(self.path)}}

    def export(self, trainer: TweenerTrainer, gathered: Gathered, curve: Sequence[Row]) -> Export:
        """What is written at the end: the card tells the path predictor it was trained with."""
        done = super().export(trainer, gathered, curve)
        classes = compute_classes(trainer.network, gathered.parts.train, self.labels)
        return replace(done, data={**done.data, "path": checkpoints.compute_hash(self.path), **classes})

    def format_shape(self) -> list[str]:
        """Options for a network that is not the usual one."""
        shape = ["--plain"] * (not self.config.skips)
        return ["--paper"] if self.config.widths == generator.PAPER.widths else shape

    def format_command(self) -> str:
        """What to type for the same run, for the card."""
        labels = "" if self.labels == LABELS else f" --labels '{self.labels}'"
        return super().format_command() + labels + (" --path PATH" if self.path != "path" else "")


def _set_moments(network: GeneratorNetwork, windows: PoseWindows) -> None:
    """Tell the network means and spreads of the places that it sees along their heading, mirrored ones too."""
    batch = windows.draw(4000, 4, make_generator(0))
    local = batch.local_matrices()
    seen = see_from_hips(kinematics.positions_from_matrices(CANONICAL, local), local[..., 0, :, :])
    seen = seen + batch.root_position[..., None, :] * torch.tensor([0.0, 1.0, 0.0])
    places = torch.cat([seen, mirror_positions(seen)]).flatten(0, 1)
    network.mean.copy_(places.mean(dim=0))
    network.std.copy_(places.std(dim=0).clamp_min(_MIN_STD))
