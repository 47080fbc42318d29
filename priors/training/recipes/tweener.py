"""Training of the generator of long in-betweens by distances (Zhou et al. 2020, sections 3.4 to 3.6, appendix C).

Part of each batch are windows of one clip, whose truth is known; the others (`TweenerSettings.spliced`) are spliced of
several, of which only keys and style are. What lies between keys of different clips is held by what the generator
learnt in windows of one; the paper's critic is left out, with which results were no better.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from mapctl import kinematics, rotations
from mapctl.inbetweening.partial_motion import KnownParts, PartialMotion, interpolate_partial_motion
from mapctl.inbetweening.position_image import mirror_positions
from mapctl.metrics.liveliness import NOTHING, Liveliness, measure_liveliness, see_from_hips
from mapctl.skeleton import CANONICAL
from priors import checkpoints
from priors.config import require_at_least
from priors.training.augmentation.key_layouts import KeySequences, KeySettings, draw_splices, draw_windows
from priors.training.augmentation.pose_windows import PoseWindows, find_kind
from priors.training.corpus import Corpus, Split
from priors.training.devices import make_generator
from priors.training.recipe import Export, Gathered, NetworkRecipe, Row, average_logarithms
from priors.training.recipes.tweener_losses import LossWeights, compute_tweener_losses
from priors.training.trainer import GradientTrainer
from priors.tweening import path as path_predictor
from priors.tweening.class_vectors import compute_classes, group_clips
from priors.tweening.generator import GeneratorConfig, GeneratorNetwork
from priors.tweening.keys import ToldParts, make_key_image
from priors.tweening.path import PathNetwork
from priors.tweening.styles import LABELS, find_class

_SHORTEST_WINDOW, _LEAST_WINDOW = 64, 32  # frames
_MIN_STD = 0.05  # metres
_FOREIGN_STYLES = 0.7  # share of styles of spliced sequences that are of another clip
_STYLE_POSES = 2, 8
_VALIDATED_FRAMES = 192  # of the gap that is validated, 6.4 s; of shorter clips all but the ends
_SHORTEST_VALIDATED = 90
_VALIDATED_OF_KIND = 24


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


class TweenerTrainer(GradientTrainer[GeneratorNetwork]):
    """Draws sequences, hides all but their keys, and brings the generator nearer to what was between."""

    def __init__(self, config: GeneratorConfig, settings: TweenerSettings, corpus: Corpus, path: PathNetwork):
        self.path = path.to(torch.get_default_device())
        self.windows = PoseWindows(corpus, kinds=settings.kinds, evenness=settings.evenness)
        fits = int(int(self.windows.lengths.max()) / (1 + settings.tempo)) - 1
        self.longest = min(settings.window, fits)
        super().__init__(lambda: GeneratorNetwork(config, bfloat16=settings.bfloat16), settings)
        _set_moments(self.network, self.windows)

    def make_optimisers(self) -> dict[str, torch.optim.Optimizer]:
        """Adam with the short memory that pays where the data change from step to step."""
        return {"optimiser": torch.optim.Adam(self.network.parameters(), lr=self.learning_rate, betas=(0.5, 0.9))}

    def losses(self) -> dict[str, Tensor]:
        """Compute the losses of a newly drawn batch."""
        settings = self.settings
        progress = self.progress
        reach = round(1.25 * settings.layout.longest_at(progress))
        shortest = min(_SHORTEST_WINDOW, self.longest)
        frames = self._draw_frames(shortest, min(self.longest, shortest + reach))
        one = draw_windows(
            self.windows,
            max(1, round((1 - settings.spliced) * settings.batch / frames)),
            frames,
            settings.layout,
            progress=progress,
            tempo=settings.tempo,
            generator=self.generator,
        )
        frames = self._draw_frames(*settings.splice)
        batch = max(1, round(settings.spliced * settings.batch / frames))
        other = draw_splices(self.windows, batch, frames, settings.layout, progress=progress, generator=self.generator)
        parts, spliced = (
            self._compare(sequences, foreign) for sequences, foreign in ((one, 0.0), (other, _FOREIGN_STYLES))
        )
        parts["loss"] = parts["loss"] + spliced["loss"]
        return parts | {f"spliced_{name}": spliced[name] for name in ("keys_cm", "root_cm", "style_cm", "dwell_cm")}

    def _draw_frames(self, shortest: int, longest: int) -> int:
        share = float(torch.rand((), generator=self.generator))
        return round(shortest * (max(shortest, longest) / shortest) ** share)

    def _compare(self, sequences: KeySequences, foreign: float) -> dict[str, Tensor]:
        poses = draw_style_poses(self.windows, sequences, foreign, self.generator)
        styled = torch.rand(len(poses), generator=self.generator) < self.settings.styled
        weights = self.settings.weights
        return compute_tweener_losses(self.network, self.path, sequences, poses, styled, weights)

    def validate(self, corpus: Corpus) -> dict[str, Any]:
        """Measure gaps of unseen clips (see `measure_kinds`)."""
        return measure_kinds(self.network, corpus, self.settings.kinds)


@dataclass(frozen=True)
class TweenerRecipe(NetworkRecipe[GeneratorConfig, TweenerSettings, TweenerTrainer]):
    """What to train the generator on, and how."""

    kind = "tweener"
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

    def draw_trainer(self, parts: Split) -> TweenerTrainer:
        """Make the trainer with drawn weights."""
        group_clips(parts.train.names, self.labels)  # what the end of training needs
        network = path_predictor.load(self.path).network
        network.reduced_precision = self.settings.bfloat16
        return TweenerTrainer(self.config, self.settings, parts.train, network)

    def score(self, row: Row) -> float:
        """Error of unseen gaps over slerp's, geometric mean over kinds of clips."""
        kinds = [name.removesuffix("_slerp_cm") for name, value in row.items() if name.endswith("_slerp_cm") and value]
        pairs = [(row.get(f"{kind}_error_cm"), row[f"{kind}_slerp_cm"]) for kind in kinds if "before_" not in kind]
        return average_logarithms(error / slerp for error, slerp in pairs if error is not None)

    def describe_run(self, trainer: TweenerTrainer, corpus: Corpus) -> dict[str, Row]:
        """What must not change between a run's parts."""
        return {**super().describe_run(trainer, corpus), "path": {"hash": checkpoints.compute_hash(self.path)}}

    def export(self, trainer: TweenerTrainer, gathered: Gathered, curve: Sequence[Row]) -> Export:
        """What is written at the end: the card tells the path predictor it was trained with."""
        done = super().export(trainer, gathered, curve)
        classes = compute_classes(trainer.network, gathered.parts.train, self.labels)
        return replace(done, data={**done.data, "path": checkpoints.compute_hash(self.path), **classes})


def _set_moments(network: GeneratorNetwork, windows: PoseWindows) -> None:
    """Tell the network means and spreads of the places that it sees along their heading, mirrored ones too."""
    batch = windows.draw(4000, 4, make_generator(0))
    local = batch.local_matrices()
    seen = see_from_hips(kinematics.positions_from_matrices(CANONICAL, local), local[..., 0, :, :])
    seen = seen + batch.root_position[..., None, :] * torch.tensor([0.0, 1.0, 0.0])
    places = torch.cat([seen, mirror_positions(seen)]).flatten(0, 1)
    network.mean.copy_(places.mean(dim=0))
    network.std.copy_(places.std(dim=0).clamp_min(_MIN_STD))


def draw_style_poses(
    windows: PoseWindows, sequences: KeySequences, foreign: float, generator: torch.Generator
) -> Float[Tensor, "batch poses joints 3"]:
    """Draw poses anywhere in each sequence, or, of this share of them, in another clip: places from the hips, metres,
    without the hips' rotation."""
    batch, frames = sequences.clip.shape
    few, many = _STYLE_POSES
    count = int(torch.randint(few, many + 1, (), generator=generator))
    at = torch.randint(frames, (batch, count), generator=generator)
    own = torch.take_along_dim(sequences.motion.quats, at[..., None, None], dim=1)
    one = torch.ones(batch, dtype=torch.long)
    clip = windows.picker.pick(one, generator)[0][:, None].expand(-1, count)
    time = (torch.rand(batch, count, generator=generator) * windows.lengths[clip]).floor().double()
    other = torch.rand(batch, generator=generator) < foreign
    local = rotations.to_matrix(torch.where(other[:, None, None, None], windows.gather(clip, time).quats, own))
    local[..., 0, :, :] = torch.eye(3)
    return kinematics.positions_from_matrices(CANONICAL, local)


@torch.no_grad()
def measure_kinds(network: GeneratorNetwork, corpus: Corpus, kinds: Sequence[str]) -> dict[str, Any]:
    """By kind of clips with one long gap between two poses: error beside slerp's, cm, and speed, spread and jerk over
    mocap's, of sums."""
    windows = PoseWindows(corpus, kinds=kinds, evenness=1.0)
    kind_of = [find_kind(name, kinds) for name in corpus.names]
    row: dict[str, Any] = {}
    for kind, name in enumerate([*kinds, "other"]):
        found = [number for number, each in enumerate(kind_of) if each == kind]
        found = [one for one in found if int(windows.lengths[one]) >= _SHORTEST_VALIDATED + 2]
        if found:
            row |= {f"{name}_{what}": value for what, value in _measure_clips(network, windows, found).items()}
    return row


def _measure_clips(network: GeneratorNetwork, windows: PoseWindows, clips: Sequence[int]) -> dict[str, float]:
    sums = {"made": NOTHING, "slerp": NOTHING, "true": NOTHING}
    for number in clips[:_VALIDATED_OF_KIND]:
        frames = min(_VALIDATED_FRAMES + 2, int(windows.lengths[number]))
        motion = windows.at(torch.tensor([number]), torch.zeros(1, dtype=torch.long), frames, torch.ones(1))
        for name, found in measure_gap(network, motion).items():
            sums[name] += found
    made, slerp, true = (sums[name] for name in ("made", "slerp", "true"))
    return {
        "error_cm": made.error / made.count,
        "slerp_cm": slerp.error / slerp.count,
        "speed": made.speed / true.speed,
        "spread": made.spread / true.spread,
        "jerk": made.jerk / true.jerk,
    }


@torch.no_grad()
def measure_gap(network: GeneratorNetwork, motion: PartialMotion) -> dict[str, Liveliness]:
    """Measure what is made between the first and the last pose of one motion, beside slerp and the truth."""
    known = torch.zeros(motion.heading.shape, dtype=torch.bool)
    known[:, [0, -1]] = True
    image = make_key_image(motion, ToldParts.whole(known))
    made = network(image, torch.zeros(1, network.config.style)).turn_to_world(image)
    local = motion.local_matrices()
    true = see_from_hips(kinematics.positions_from_matrices(CANONICAL, local), local[..., 0, :, :])[0]
    shown = replace(motion, known=KnownParts.whole(known))
    guess = interpolate_partial_motion(shown, motion.quats[0, 0], 0.0).local_matrices()
    slerp = see_from_hips(kinematics.positions_from_matrices(CANONICAL, guess), guess[..., 0, :, :])[0]
    mine = see_from_hips(made.places, made.local_matrix[..., 0, :, :])[0]
    inside = ~known[0]
    return {
        name: measure_liveliness(seen, true, inside)
        for name, seen in (("made", mine), ("slerp", slerp), ("true", true))
    }
