"""Training of the generator of long in-betweens by distances (Zhou et al. 2020, sections 3.4 to 3.6, appendix C).

Half of each batch are windows of one clip, whose truth is known; half are spliced of several, of which only keys and
style are. There is no critic: what lies between keys of different clips is held by what the generator learnt in others.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import avg_pool1d
from torch.nn.functional import binary_cross_entropy_with_logits as cross_entropy

from mapctl import kinematics
from mapctl.inbetweening.partial_motion import KnownParts, PartialMotion, interpolate_partial_motion
from mapctl.inbetweening.position_image import mirror_positions
from mapctl.inbetweening.root_trajectory import LocalMotion, RootTrajectory
from mapctl.metrics.liveliness import NOTHING, Liveliness, measure_liveliness, see_from_hips
from mapctl.metrics.root_prediction import compute_displacement_errors
from mapctl.numerics.intervals import last_observed, next_observed
from mapctl.skeleton import CANONICAL, TOE_JOINTS
from priors.config import require_at_least
from priors.training.augmentation.key_layouts import KeySequences, KeySettings, draw_splices, draw_windows
from priors.training.augmentation.pose_windows import PoseWindows, find_kind
from priors.training.corpus import Corpus, Split
from priors.training.recipe import Export, Gathered, NetworkRecipe, Row
from priors.training.trainer import GradientTrainer
from priors.tweening import path as path_predictor
from priors.tweening.generator import GeneratorConfig, GeneratorNetwork, regularise_batch
from priors.tweening.keys import make_key_image
from priors.tweening.path import PathNetwork
from priors.tweening.range_constrained import ConstrainedPose

VALIDATED_FRAMES = 192
"""Frames of the gap that is validated, 6.4 s; of shorter clips all but the ends."""
_SHORTEST_VALIDATED = 90
_VALIDATED_OF_KIND = 24
_SHORTEST_WINDOW, _LEAST_WINDOW = 48, 32  # frames
_SHORTEST_SPLICE, _LONGEST_SPLICE = 192, 1024  # frames
_HALF_WEIGHT_FRAMES = 60.0  # away from the nearest key
_MIN_STD = 0.05  # metres
_STYLE_POSES = 6
_DWELL = 5  # frames for which a pose of the style must be near: none flashes up
_PATH_SPANS = (1, 8, 32)


@dataclass(frozen=True)
class TweenerSettings:
    """How the generator is trained."""

    steps: int = 16_000
    """Updates."""
    batch: int = 8192
    """Frames an update."""
    spliced: float = 0.3
    """Share of them in sequences that are spliced of several clips; the others are in windows of one."""
    window: int = 330
    """Frames of the longest window of one clip; of those the shortest have 48."""
    learning_rate: float = 1e-3
    """At its highest; it falls to nothing along a cosine."""
    places: float = 10.0
    """Weight of the distance of joints from where they truly are, seen from the hips, metres."""
    pace: float = 20.0
    """Weight of the error of their steps, metres a frame."""
    turns: float = 1.0
    """Weight of the error of local rotations: norm of the difference of matrices."""
    keys: float = 10.0
    """Weight of distance and rotations at keys, beside those everywhere."""
    feet: float = 5.0
    """Weight of the planted toes' steps, metres a frame."""
    contacts: float = 0.05
    """Weight of the cross entropy of the contacts that the path predictor sees, nats."""
    path: float = 2.0
    """Weight of the error of the hips' displacements over 1, 8 and 32 frames, metres, where they are known."""
    root: float = 0.3
    """Weight of the distance of the hips' path from its places at keys (Eq. 10), metres."""
    style: float = 2.0
    """Weight of the distance of the style's poses from the nearest that are made (Eq. 11), metres."""
    styled: float = 0.35
    """Share of sequences that are given a style."""
    regularisation: float = 0.05
    """Weight of batch regularisation (Eq. 9)."""
    tempo: float = 0.1
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
        self.settings, self.path = settings, path
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
        return {"optimiser": torch.optim.Adam(self.network.parameters(), lr=self.learning_rate, betas=(0.5, 0.9))}

    def losses(self) -> dict[str, Tensor]:
        """Compute the losses of a newly drawn batch."""
        settings = self.settings
        progress = self.step / settings.steps
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
        frames = self._draw_frames(_SHORTEST_SPLICE, _LONGEST_SPLICE)
        batch = max(1, round(settings.spliced * settings.batch / frames))
        other = draw_splices(self.windows, batch, frames, settings.layout, progress=progress, generator=self.generator)
        parts, spliced = self._compute(one), self._compute(other)
        parts["loss"] = parts["loss"] + spliced["loss"]
        return parts | {f"spliced_{name}": spliced[name] for name in ("keys_cm", "root_cm", "style_cm")}

    def _draw_frames(self, shortest: int, longest: int) -> int:
        share = float(torch.rand((), generator=self.generator))
        return round(shortest * (max(shortest, longest) / shortest) ** share)

    def _compute(self, sequences: KeySequences) -> dict[str, Tensor]:
        poses = draw_style_poses(self.windows, sequences, self.generator)
        styled = torch.rand(len(poses), generator=self.generator) < self.settings.styled
        return compute_tweener_losses(self.network, self.path, sequences, poses, styled, self.settings)

    @torch.no_grad()
    def validate(self, corpus: Corpus) -> dict[str, Any]:
        """By kind of unseen clips with one long gap between two poses: error beside slerp's, and speed, spread and jerk
        over mocap's, of sums."""
        windows = PoseWindows(corpus, kinds=self.settings.kinds, evenness=1.0)
        kinds = [find_kind(name, self.settings.kinds) for name in corpus.names]
        row: dict[str, Any] = {}
        for kind, name in enumerate([*self.settings.kinds, "other"]):
            found = [number for number, each in enumerate(kinds) if each == kind]
            found = [one for one in found if int(windows.lengths[one]) >= _SHORTEST_VALIDATED + 2]
            if found:
                row |= {f"{name}_{what}": value for what, value in self._measure(windows, found).items()}
        return row

    def _measure(self, windows: PoseWindows, clips: Sequence[int]) -> dict[str, float]:
        sums = {"made": NOTHING, "slerp": NOTHING, "true": NOTHING}
        for number in clips[:_VALIDATED_OF_KIND]:
            frames = min(VALIDATED_FRAMES + 2, int(windows.lengths[number]))
            motion = windows.at(torch.tensor([number]), torch.zeros(1, dtype=torch.long), frames, torch.ones(1))
            for name, found in measure_gap(self.network, motion).items():
                sums[name] += found
        made, slerp, true = (sums[name] for name in ("made", "slerp", "true"))
        return {
            "error_cm": made.error / made.count,
            "slerp_cm": slerp.error / slerp.count,
            "speed": made.speed / true.speed,
            "spread": made.spread / true.spread,
            "jerk": made.jerk / true.jerk,
        }


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

    def check(self) -> None:
        """Before anything is read."""
        super().check()
        path_predictor.load(self.path)

    def make_untaught(self, parts: Split) -> TweenerTrainer:
        """The trainer, its weights drawn."""
        network = path_predictor.load(self.path).network
        network.reduced_precision = self.settings.bfloat16
        return TweenerTrainer(self.config, self.settings, parts.train, network)

    def pin(self, trainer: TweenerTrainer, corpus: Corpus) -> dict[str, Row]:
        """What must not change between a run's parts."""
        return {**super().pin(trainer, corpus), "path": {"hash": path_predictor.compute_hash(self.path)}}

    def export(self, trainer: TweenerTrainer, gathered: Gathered, curve: Sequence[Row]) -> Export:
        """What is written at the end: the card tells the path predictor it was trained with."""
        done = super().export(trainer, gathered, curve)
        return replace(done, data={**done.data, "path": path_predictor.compute_hash(self.path)})

    def format_shape(self) -> list[str]:
        """Whether it is the paper's plain network."""
        return [] if self.config.skips else ["--plain"]

    def format_command(self) -> str:
        """What to type for the same run, for the card."""
        return super().format_command() + (" --path PATH" if self.path != "path" else "")


def draw_style_poses(
    windows: PoseWindows, sequences: KeySequences, generator: torch.Generator
) -> Float[Tensor, "batch poses joints 3"]:
    """Draw poses anywhere in a clip of each sequence: places from the hips, metres, without the hips' rotation."""
    batch, frames = sequences.clip.shape
    at = (torch.rand(batch, generator=generator) * frames).long()
    clip = sequences.clip[torch.arange(batch), at][:, None].expand(-1, _STYLE_POSES)
    time = (torch.rand(clip.shape, generator=generator) * windows.lengths[clip]).floor().double()
    local = windows.gather(clip, time).local_matrices()
    places = see_without_root(kinematics.positions_from_matrices(CANONICAL, local), local[..., 0, :, :])
    return torch.where(sequences.mirrored[:, None, None, None], mirror_positions(places), places)


def see_without_root(
    places: Float[Tensor, "*batch joints 3"], hips_world_matrix: Float[Tensor, "*batch 3 3"]
) -> Float[Tensor, "*batch joints 3"]:
    """Return places from the hips without the hips' rotation."""
    return places @ hips_world_matrix


def compute_tweener_losses(
    network: GeneratorNetwork,
    path: PathNetwork,
    sequences: KeySequences,
    style_poses: Float[Tensor, "batch poses joints 3"],
    styled: Bool[Tensor, " batch"],
    settings: TweenerSettings,
) -> dict[str, Tensor]:
    """The loss, and in plain units the errors it is made of.

    Where a performer's poses between keys are known they count the less the farther the nearest key is, since more and
    more other motions would do as well.
    """
    motion, known = sequences.motion, sequences.known
    image = make_key_image(motion, known)
    made_poses = network(image, network.style(style_poses) * styled[:, None])
    made = made_poses.turn_to_world(image)
    local = motion.local_matrices()
    wanted = kinematics.positions_from_matrices(CANONICAL, local)
    weight = _weigh_frames(known) * sequences.truthful
    shown = _Errors(made, wanted, local)
    terms = {
        "places": shown.places(weight),
        "turns": shown.turns(weight),
        "pace": shown.pace(_between(weight)),
        "feet": shown.feet(motion, _between(weight)),
        "keys": shown.places(known.float()) + 0.1 * shown.turns(known.float()),
    }
    heading = kinematics.heading_of_matrix(made.local_matrix[..., 0, :, :])
    trajectory = path(LocalMotion.of_world(made.places, heading))
    terms |= _compute_path_terms(trajectory, heading, sequences)
    without_root = see_without_root(made.places, made.local_matrix[..., 0, :, :])
    terms["style"] = _compute_style_error(without_root, style_poses, styled & ~sequences.truthful.all(dim=1))
    terms["regularisation"] = regularise_batch(made_poses.responses)
    loss = torch.stack([getattr(settings, name) * value for name, value in terms.items()]).sum()
    metres = ("places", "pace", "feet", "keys", "path", "root", "style")
    told = {f"{name}_cm": 100 * terms[name] for name in metres}
    return {"loss": loss, **told, **{name: terms[name] for name in ("turns", "contacts", "regularisation")}}


@dataclass(frozen=True, eq=False)
class _Errors:
    """Errors of poses, weighed by frame."""

    made: ConstrainedPose
    wanted: Float[Tensor, "batch frames joints 3"]
    local: Float[Tensor, "batch frames joints 3 3"]

    def places(self, weight: Tensor) -> Tensor:
        return _average(_length(self.made.places - self.wanted).mean(dim=-1), weight)

    def turns(self, weight: Tensor) -> Tensor:
        return _average(_length((self.made.local_matrix - self.local).flatten(-2)).mean(dim=-1), weight)

    def pace(self, weight: Tensor) -> Tensor:
        return _average(_length(torch.diff(self.made.places - self.wanted, dim=1)).mean(dim=-1), weight)

    def feet(self, motion: PartialMotion, weight: Tensor) -> Tensor:
        slip = torch.diff((self.made.places - self.wanted)[..., list(TOE_JOINTS), :], dim=1)
        planted = motion.contacts[:, 1:] * motion.contacts[:, :-1]
        return _average(_length(slip), planted * weight[..., None])


def _compute_path_terms(trajectory: RootTrajectory, heading: Tensor, sequences: KeySequences) -> dict[str, Tensor]:
    """Errors of where the hips go, as the path predictor sees it, metres, and of contacts, nats."""
    hips, truthful = sequences.motion.root_position, sequences.truthful
    made = trajectory.integrate(heading)
    steps = truthful.float()
    errors = []
    for span in [span for span in _PATH_SPANS if span < steps.shape[1]]:
        whole = steps.unfold(1, span + 1, 1).amin(dim=-1)
        errors.append(_average(compute_displacement_errors(made[..., ::2], hips[..., ::2], span), whole))
    height = _average((made[..., 1] - hips[..., 1]).abs(), steps)
    share = sequences.known.float() / sequences.known.sum(dim=1, keepdim=True).clamp_min(1)
    off = (made - hips)[..., ::2]
    off = off - (off * share[..., None]).sum(dim=1, keepdim=True)
    nats = cross_entropy(trajectory.contacts, sequences.motion.contacts, reduction="none").mean(dim=-1)
    return {
        "path": torch.stack(errors).mean() + height,
        "root": (_length(off) * share).sum(dim=1).mean(),
        "contacts": _average(nats, _weigh_frames(sequences.known) * truthful),
    }


def _compute_style_error(
    made: Float[Tensor, "batch frames joints 3"],
    wanted: Float[Tensor, "batch poses joints 3"],
    counts: Bool[Tensor, " batch"],
) -> Tensor:
    """How far the style's poses are from the nearest that are made and kept for some frames (Eq. 11), metres."""
    apart = torch.cdist(wanted.flatten(-2), made.flatten(-2)) / len(CANONICAL.names) ** 0.5
    nearest = avg_pool1d(apart, _DWELL, stride=1).amin(dim=-1)
    return _average(nearest.mean(dim=-1), counts.float())


def _weigh_frames(known: Bool[Tensor, "batch frames"]) -> Float[Tensor, "batch frames"]:
    """1 at a key, half as much 2 s away from the nearest."""
    frame = torch.arange(known.shape[1])
    away = torch.minimum((frame - last_observed(known)).abs(), (next_observed(known) - frame).abs())
    return 1 / (1 + away / _HALF_WEIGHT_FRAMES)


def _between(weight: Float[Tensor, "batch frames"]) -> Tensor:
    return torch.minimum(weight[:, 1:], weight[:, :-1])


def _average(values: Tensor, weight: Tensor) -> Tensor:
    return (values * weight).sum() / weight.sum().clamp_min(1e-6)


def _length(vectors: Tensor) -> Tensor:
    """Length with a gradient at 0."""
    return vectors.square().sum(dim=-1).add(1e-8).sqrt()


@torch.no_grad()
def measure_gap(network: GeneratorNetwork, motion: PartialMotion) -> dict[str, Liveliness]:
    """Measure what is made between the first and the last pose of one motion, beside slerp and the truth."""
    known = torch.zeros(motion.heading.shape, dtype=torch.bool)
    known[:, [0, -1]] = True
    image = make_key_image(motion, known)
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


def _set_moments(network: GeneratorNetwork, windows: PoseWindows) -> None:
    """Tell the network means and spreads of the places that it sees along their heading, mirrored ones too."""
    batch = windows.draw(4000, 4, torch.Generator().manual_seed(0))
    local = batch.local_matrices()
    seen = see_from_hips(kinematics.positions_from_matrices(CANONICAL, local), local[..., 0, :, :])
    seen = seen + batch.root_position[..., None, :] * torch.tensor([0.0, 1.0, 0.0])
    places = torch.cat([seen, mirror_positions(seen)]).flatten(0, 1)
    network.mean.copy_(places.mean(dim=0))
    network.std.copy_(places.std(dim=0).clamp_min(_MIN_STD))
