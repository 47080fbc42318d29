"""Training of the generator of long in-betweens by distances (Zhou et al. 2020, sections 3.4 to 3.6, appendix C).

Most of each batch are windows of one clip, whose truth is known; the others are spliced of excerpts of several clips
with a long gap at every splice, of which only keys and style are. Gaps grow in the course of training. What lies
between keys of different clips is held by what the generator learnt in windows of one; the paper's critic is left out,
with which results were no better. Some keys are less than whole poses (section 5): halves, the hips alone, some joints,
positions on the ground, and drawings seen from one side.
"""

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Annotated

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import avg_pool1d
from torch.nn.functional import binary_cross_entropy_with_logits as cross_entropy
from tyro.conf import arg

from mapctl import kinematics, motion_dna, rotations
from mapctl.errors import RequestError
from mapctl.features import PRIOR_FPS
from mapctl.inbetweening.partial_motion import PartialMotion
from mapctl.inbetweening.position_image import mirror_positions
from mapctl.inbetweening.root_trajectory import LocalMotion, RootTrajectory, compute_displacement_errors
from mapctl.metrics.body import see_from_hips
from mapctl.numerics.intervals import last_observed, next_observed, true_intervals
from mapctl.pose import BodyPose
from mapctl.skeleton import CANONICAL, TOE_JOINTS
from priors import checkpoints
from priors.path import ConvPathPredictor, PathNetwork
from priors.training.data import Corpus, Split
from priors.training.gaps import InbetweenerTrainer
from priors.training.loop import Count, Export, Name, NetworkSettings, Row, make_generator
from priors.training.windows import PoseWindows, choose_rows, draw_length, measure_lengths
from priors.tweener import (
    LABELS,
    PAPER,
    GeneratorConfig,
    GeneratorNetwork,
    GivenParts,
    Tweener,
    encode_classes,
    find_class,
    make_key_image,
    regularise_batch,
)

_JOINTS = CANONICAL.num_joints
_LEGS = frozenset(j for j, name in enumerate(CANONICAL.names) if name.endswith(("Leg", "Foot", "Toes")))

WEIGHTS = {
    "positions": 10.0,  # distance of joints from their true positions, seen from the hips, metres
    "turns": 1.0,  # error of local rotations: norm of the difference of matrices
    "pace": 20.0,  # error of the joints' steps, metres a frame
    "activity": 20.0,  # error of joints' mean speed and acceleration over a second, metres a frame (and frame)
    "feet": 5.0,  # the planted toes' steps, metres a frame
    "keys": 10.0,  # distance and rotations at keys, beside those everywhere
    "path": 2.0,  # error of the hips' displacements over 1, 8, 32 and 96 frames, metres, where they are known
    "root": 0.3,  # distance of the hips' path from its positions at keys (Eq. 10), metres
    "contacts": 0.05,  # cross entropy of the contacts that the path predictor finds, nats
    "style": 4.0,  # distance of the style's poses from the nearest generated ones (Eq. 11), metres
    "dwell": 2.0,  # distance from the style's poses of those that come nearest to one in each gap (Eq. 12), metres
    "regularisation": 0.05,  # batch regularisation (Eq. 9)
}
"""Weights of the losses."""
_METRES = ("positions", "pace", "activity", "feet", "keys", "path", "root", "style", "dwell")
_HALF = 60.0  # frames from the nearest key at which what a performer did counts half
_DWELL = 5  # frames for which a pose of the style must be near: none flashes up
_PATH_SPANS = (1, 8, 32, 96)
_SOME = 3  # of so many sequences one has its trajectory predicted and its rotations compared: they cost as much as all
_ACTIVITY_FRAMES = 32  # over which joints' speeds and accelerations are averaged
_DNA_GAP = 90  # frames, 3 s, for each of which a gap has a pose of the style (Eq. 12)
_MIN_STD = 0.05  # metres
_LEAST = 1e-8  # of squared errors, for a finite gradient

# Sequences.
_SPLICED = 0.25  # share of the frames that are in sequences spliced of several clips
_SPLICE = (192, 1024)  # frames of the shortest and the longest spliced sequence
_SHORTEST_WINDOW, _LEAST_WINDOW = 64, 32  # frames
_TEMPO = 0.15  # largest change of tempo of windows of one clip, as a share
_STYLED = 0.35  # share of sequences with a style: poses that are in them, or, where spliced, more often of another clip
_FOREIGN_STYLES = 0.7  # share of styles of spliced sequences that are of another clip
_STYLE_POSES = 2, 8
_ROLLS = 4096  # random numbers drawn at once

# Keys.
_FIRST_LONGEST_GAP, _LONGEST_GAP = 30.0, 480.0  # frames when training begins, and grown up (paper: 600 at 60 fps)
_SHORTEST_GAP = 30.0  # frames of the shortest longest gap of a sequence; the logarithm is drawn evenly
_GROWN = 0.25  # share of training after which gaps grow no more
_SPLICED_FROM = 90  # frames of the shortest gap between keys of different clips, 3 s
_RUNS, _RUN = 0.4, 12  # share of keys that are several frames, a pose and its pace, and their most frames
_OPEN_ENDS = 0.1  # share of sequences that begin, and as many that end, without a key
_SPEED = 1.5  # m/s, below which the hips travel where clips are spliced
_HALVES, _POSITION_KEYS, _DRAWINGS = 0.1, 0.1, 0.1  # shares with keys of parts, of ground positions, and drawings


@dataclass(frozen=True, eq=False)
class KeySequences:
    """A batch of sequences of one length."""

    motion: PartialMotion  # poses by frame; between keys of different clips they are anything finite
    given: GivenParts  # known parts of the frames that are keys
    truthful: Bool[Tensor, "batch frames"]  # whether poses are a performer's: those of keys, and between keys of a clip
    clip: Int[Tensor, "batch frames"]  # number of the clip that a frame is of
    mirrored: Bool[Tensor, " batch"]  # whether left and right are exchanged

    @property
    def known(self) -> Bool[Tensor, "batch frames"]:
        """Whether a frame is a key."""
        return self.given.known


@dataclass(frozen=True, kw_only=True)
class TweenerSettings(NetworkSettings):
    """Train a tweener, which generates motion between keys that are seconds apart."""

    kind = "tweener"
    used_by = "use it with mapctl tween --method tweener --inbetweener"
    ours, papers = GeneratorConfig(), PAPER
    shape_options = ("paper",)
    least_window = _LEAST_WINDOW

    steps: Count = 16_000
    """Steps in all."""
    batch: Count = 8192
    """Frames a step."""
    window: Count = 330
    """Frames of the longest window of one clip; of those the shortest have 64."""
    path: Name = "path"
    """Path predictor, bundled or trained, for the root trajectory of what is generated."""
    paper: bool = False
    """The network of Zhou et al. 2020; other options still hold."""
    labels: Annotated[str, arg(metavar="REGEX")] = LABELS
    """Class of a clip by its path below the data folder, for `mapctl tween --dna NAME`: what the first group matches;
    if not given, Bandai Namco's content, else the folder or the file's name without a number."""

    def check(self) -> None:
        super().check()
        find_class("", self.labels)
        ConvPathPredictor.load(self.path)

    def make_trainer(self, parts: Split) -> "TweenerTrainer":
        group_clips(parts.train.names, self.labels)  # what the end of training needs
        return TweenerTrainer(self, parts.train)


class TweenerTrainer(InbetweenerTrainer[GeneratorNetwork]):
    """Draws sequences, hides all but their keys, and brings the generator nearer to what was between."""

    gaps = (45, 90, 180)

    def __init__(self, settings: TweenerSettings, corpus: Corpus):
        self.path = ConvPathPredictor.load(settings.path).network.to(torch.get_default_device())
        self.path.reduced_precision = settings.bfloat16
        self.windows = PoseWindows(corpus)
        self.longest = min(settings.window, int(int(self.windows.lengths.max()) / (1 + _TEMPO)) - 1)
        self.config = settings.find_config()
        super().__init__(settings, lambda: GeneratorNetwork(self.config, bfloat16=settings.bfloat16))
        _set_moments(self.network, self.windows)
        self.begin()

    def make_optimisers(self) -> dict[str, torch.optim.Optimizer]:
        """Adam with the short memory that pays where the data change from step to step."""
        rate = self.settings.learning_rate
        return {"optimiser": torch.optim.Adam(self.network.parameters(), lr=rate, betas=(0.5, 0.9))}

    def losses(self) -> dict[str, Tensor]:
        batch, progress, generator = self.settings.batch, self.progress, self.generator
        shortest, reach = min(_SHORTEST_WINDOW, self.longest), round(1.25 * find_longest_gap(progress))
        frames = draw_length(shortest, min(self.longest, shortest + reach), generator)
        count = max(1, round((1 - _SPLICED) * batch / frames))
        one = draw_windows(self.windows, count, frames, progress=progress, generator=generator)
        frames = draw_length(*_SPLICE, generator)
        count = max(1, round(_SPLICED * batch / frames))
        other = draw_splices(self.windows, count, frames, progress=progress, generator=generator)
        parts, spliced = self._compare(one, 0.0), self._compare(other, _FOREIGN_STYLES)
        parts["loss"] = parts["loss"] + spliced["loss"]
        return parts | {f"spliced_{name}": spliced[name] for name in ("keys_cm", "root_cm", "style_cm", "dwell_cm")}

    def _compare(self, sequences: KeySequences, foreign: float) -> dict[str, Tensor]:
        poses = draw_style_poses(self.windows, sequences, foreign, self.generator)
        styled = torch.rand(len(poses), generator=self.generator) < _STYLED
        return compute_tweener_losses(self.network, self.path, sequences, poses, styled)

    def make_inbetweener(self, network: GeneratorNetwork) -> Tweener:
        card = checkpoints.Card(self.settings.kind, {}, licence="")
        return Tweener("in training", network, card, ConvPathPredictor.load(self.settings.path))

    def identify(self) -> Row:
        """Return the path predictor, which must not change between a run's parts."""
        return {"path": checkpoints.compute_hash(self.settings.path)}

    def export(self, parts: Split) -> Export:
        """Return the weights, with the path predictor and the classes for the card."""
        done = super().export(parts)
        classes = encode_classes(self.network.style, collect_dna(parts.train, self.settings.labels))
        done.data = {**self.identify(), **classes}
        return done


def find_longest_gap(progress: float) -> float:
    """Return the frames of the longest gap at a `progress` of training from 0 to 1."""
    return _FIRST_LONGEST_GAP * (_LONGEST_GAP / _FIRST_LONGEST_GAP) ** min(1.0, progress / _GROWN)


def choose_parts(
    known: Bool[Tensor, "batch frames"], heading: Float[Tensor, "batch frames"], rolls: Iterator[float]
) -> GivenParts:
    """Choose what is known in frames that are keys, of motions with these headings, radians: of most sequences all of
    the pose."""
    whole = GivenParts.whole(known)
    axes, faced, view = whole.axes.clone(), whole.heading.clone(), whole.view.clone()
    for row in range(len(known)):
        kind = next(rolls)
        runs = [slice(start, stop) for _, start, stop in true_intervals(known[row][:, None])]
        if not runs:
            continue
        if kind < _HALVES:
            for run in runs:
                axes[row, run] = _draw_part(rolls)[:, None]
        elif kind < _HALVES + _POSITION_KEYS:
            kept = 0.4 * (next(rolls) < 0.6)
            for run in runs:
                if next(rolls) >= kept:
                    axes[row, run], faced[row, run] = _GROUND_POSITION, False
        elif kind < _HALVES + _POSITION_KEYS + _DRAWINGS:
            view[row] = _draw_view(float(heading[row, runs[0].start]), rolls)
            for run in runs:
                if next(rolls) < 0.75:
                    axes[row, run], faced[row, run] = False, False
                    axes[row, run.start] = _draw_drawing(rolls)
    return GivenParts(axes, faced, view)


def _see_joints(turning: Iterable[int]) -> Bool[Tensor, " joints"]:
    """Return which joints' positions are known by the rotations of some."""
    seen, rotations = [True], set(turning)
    for parent in CANONICAL.parents[1:]:
        seen.append(seen[parent] and parent in rotations)
    return torch.tensor(seen)


_UPPER, _LOWER = (_see_joints({0, *part}) for part in (set(range(_JOINTS)) - _LEGS, _LEGS))
_HIPS = _see_joints({0})
_GROUND_POSITION = torch.zeros(_JOINTS, 3, dtype=torch.bool)
_GROUND_POSITION[0, ::2] = True


def _draw_part(rolls: Iterator[float]) -> Bool[Tensor, " joints"]:
    """Draw which joints are known of a key."""
    kind = next(rolls)
    for share, part in ((0.3, _UPPER), (0.3, _LOWER), (0.1, _HIPS), (0.15, torch.ones(_JOINTS, dtype=torch.bool))):
        if (kind := kind - share) < 0:
            return part
    return _see_joints({0} | {joint for joint in range(_JOINTS) if next(rolls) < 0.8})


def _draw_view(heading: float, rolls: Iterator[float]) -> float:
    """Draw from where a body is seen, radians: half of the time from before, behind, the side or between these."""
    around = next(rolls)
    return heading + round(8 * around) * math.pi / 4 if next(rolls) < 0.5 else 2 * math.pi * around


def _draw_drawing(rolls: Iterator[float]) -> Bool[Tensor, "joints 3"]:
    """Draw the coordinates that a drawing shows: two of all joints or of some; the hips' third if they are placed."""
    drawn = torch.ones(_JOINTS, dtype=torch.bool)
    if next(rolls) < 0.4:
        drawn = torch.tensor([next(rolls) < 0.7 for _ in range(_JOINTS)])
        drawn[0] = True
    axes = drawn[:, None] & torch.tensor([True, True, False])
    axes[0, 2] = next(rolls) < 0.5
    return axes


def draw_windows(
    windows: PoseWindows, batch: int, frames: int, *, progress: float, generator: torch.Generator
) -> KeySequences:
    """Draw windows of single clips, half of them up to the share _TEMPO slower or faster, and keys in them."""
    varied = torch.rand(batch, generator=generator) < 0.5
    pace = torch.where(varied, 1 + _TEMPO * (2 * torch.rand(batch, generator=generator) - 1), 1.0)
    clip, first = windows.picker.pick(1 + ((frames - 1) * pace).ceil().long(), generator)
    motion = windows.at(clip, first, frames, pace)
    rolls = _roll(generator)
    known = torch.zeros(batch, frames, dtype=torch.bool)
    for row in known:
        for start, stop in _lay_keys(frames, find_longest_gap(progress), rolls):
            row[start:stop] = True
    everywhere = torch.ones_like(known)
    clip = clip[:, None].expand_as(known)
    return _finish(motion, known, everywhere, clip, rolls, generator)


def draw_splices(
    windows: PoseWindows, batch: int, frames: int, *, progress: float, generator: torch.Generator
) -> KeySequences:
    """Draw keys each of which is of another clip, at distances that are proportional to the gaps, of 3 s at least."""
    rolls, longest = _roll(generator), find_longest_gap(progress)
    shape = (batch, frames)
    clip, time = (torch.zeros(shape, dtype=torch.long) for _ in range(2))
    known, turn, shift = torch.zeros(shape, dtype=torch.bool), torch.zeros(shape), torch.zeros(*shape, 2)
    for row in range(batch):
        length, start, position = _draw_longest(longest, rolls), 0, torch.zeros(2)
        while start < frames:
            run = _draw_run(rolls)
            number, first = (int(each) for each in windows.picker.pick(torch.tensor([run]), generator))
            angle, at = torch.tensor(2 * math.pi * next(rolls)), int(windows.starts[number]) + first
            begun, ended = rotations.rotate_ground(windows.ground[[at, at + run - 1]], angle.expand(2))
            # The excerpt goes on until the next key, as nothing that counts.
            clip[row, start:], time[row, start:] = number, first + torch.arange(frames - start)
            turn[row, start:], shift[row, start:] = angle, position - begun
            known[row, start : start + run] = True
            gap = _draw_gap(length, rolls)
            gap = gap if gap >= _SPLICED_FROM else gap + _SPLICED_FROM
            travelled, towards = gap / PRIOR_FPS * _SPEED * next(rolls), 2 * math.pi * next(rolls)
            position = position + ended - begun
            position = position + travelled * torch.tensor([math.sin(towards), math.cos(towards)])
            start += run - 1 + gap
    motion = windows.gather(clip, time.double())
    root = rotations.rotate_about_y(motion.root_position, turn) + rotations.lift_ground(shift)
    motion = replace(motion, root_position=root, heading=motion.heading + turn)
    return _finish(motion, known, known, clip, rolls, generator)


def _lay_keys(frames: int, longest: float, rolls: Iterator[float]) -> Iterator[tuple[int, int]]:
    """Yield first frames of keys in a window, and one past their last."""
    length = _draw_longest(longest, rolls)
    at = 0 if next(rolls) >= _OPEN_ENDS else min(frames - 1, _draw_gap(length, rolls))
    while at < frames:
        stop = at + _draw_run(rolls)
        yield at, stop
        at = stop - 1 + _draw_gap(length, rolls)
    if next(rolls) >= _OPEN_ENDS:
        yield frames - _draw_run(rolls), frames


def _draw_longest(longest: float, rolls: Iterator[float]) -> float:
    return _SHORTEST_GAP * (longest / _SHORTEST_GAP) ** next(rolls)


def _draw_gap(longest: float, rolls: Iterator[float]) -> int:
    return max(2, round(longest * (0.3 + 0.7 * next(rolls))))


def _draw_run(rolls: Iterator[float]) -> int:
    several = next(rolls) < _RUNS
    return 2 + int(next(rolls) * (_RUN - 1)) if several else 1


def _roll(generator: torch.Generator) -> Iterator[float]:
    """Yield numbers from 0 to 1 without an end."""
    while True:
        yield from torch.rand(_ROLLS, generator=generator).tolist()


def _finish(
    motion: PartialMotion,
    known: Tensor,
    truthful: Tensor,
    clip: Tensor,
    rolls: Iterator[float],
    generator: torch.Generator,
) -> KeySequences:
    """Mirror half of the sequences, and choose what is known of keys."""
    mirrored = torch.rand(len(known), generator=generator) < 0.5
    motion = choose_rows(mirrored, motion.mirrored(), motion)
    return KeySequences(motion, choose_parts(known, motion.heading, rolls), truthful, clip, mirrored)


def compute_tweener_losses(
    network: GeneratorNetwork,
    path: PathNetwork,
    sequences: KeySequences,
    style_poses: Float[Tensor, "batch poses joints 3"],
    styled: Bool[Tensor, " batch"],
) -> dict[str, Tensor]:
    """The loss, and in plain units the errors that add up to it.

    Where a performer's poses between keys are known they count the less the farther the nearest key is, since more and
    more other motions would do as well.
    """
    motion, known = sequences.motion, sequences.known
    image = make_key_image(motion, sequences.given)
    generated_poses = network(image, network.style(style_poses) * styled[:, None])
    generated = generated_poses.turn_to_world(image)
    wanted = image.positions - image.positions[..., :1, :]  # seen from the hips, as the generated poses
    local = motion.local_matrices()
    weight = _weigh_frames(known) * sequences.truthful
    between = torch.minimum(weight[:, 1:], weight[:, :-1])
    off = generated_poses.pose.positions - wanted
    steps, wanted_steps = (torch.diff(each, dim=1) for each in (generated_poses.pose.positions, wanted))
    off_steps, planted = steps - wanted_steps, motion.contacts[:, 1:] * motion.contacts[:, :-1]
    # Of joints but the hips, from which they are seen, the coordinates that are known.
    off_known = (off * sequences.given.axes)[..., 1:, :]
    joints_known = sequences.given.axes[..., 1:, :].any(dim=-1).float()
    heading = kinematics.heading_of_matrix(generated.local_matrix[..., 0, :, :])
    some = slice(0, -(-len(known) // _SOME))
    turned = measure_lengths((generated.local_matrix[some] - local[some]).flatten(-2), _LEAST).mean(dim=-1)
    whole = sequences.given.axes[some].flatten(2).all(dim=-1).float()
    terms = {
        "positions": _average(measure_lengths(off, _LEAST).mean(dim=-1), weight),
        "turns": _average(turned, weight[some]),
        "pace": _average(measure_lengths(off_steps, _LEAST).mean(dim=-1), between),
        "activity": _compute_activity_error(steps, wanted_steps, sequences.truthful),
        "feet": _average(measure_lengths(off_steps[..., list(TOE_JOINTS), :], _LEAST), planted * between[..., None]),
        "keys": _average(measure_lengths(off_known, _LEAST), joints_known) + 0.1 * _average(turned, whole),
    }
    trajectory = path(LocalMotion.of_world(generated.positions[some], heading[some]))
    travelled = trajectory.integrate(heading[some])
    terms |= _compute_path_terms(trajectory, travelled, sequences, some)
    without_root = generated.positions @ generated.local_matrix[..., 0, :, :]
    apart = torch.cdist(style_poses.flatten(-2), without_root.flatten(-2)) / len(CANONICAL.names) ** 0.5
    # How far the style's poses are from the nearest generated ones that are held for some frames (Eq. 11).
    nearest = avg_pool1d(apart, _DWELL, stride=1).amin(dim=-1)
    terms["style"] = _average(nearest.mean(dim=-1), styled.float())
    terms["dwell"] = _compute_dwell_error(apart, known, styled)
    terms["regularisation"] = regularise_batch(tuple(each[some] for each in generated_poses.responses))
    loss = torch.stack([WEIGHTS[name] * value for name, value in terms.items()]).sum()
    shown_cm = {f"{name}_cm": 100 * terms[name] for name in _METRES}
    return {"loss": loss, **shown_cm, **{name: terms[name] for name in ("turns", "contacts", "regularisation")}}


def _compute_activity_error(
    steps: Float[Tensor, "batch later joints 3"], wanted: Float[Tensor, "batch later joints 3"], truthful: Tensor
) -> Tensor:
    """Compare speeds and accelerations by joint, whenever within a second they are."""
    error = steps.new_zeros(())
    if truthful.shape[1] < _ACTIVITY_FRAMES + 2:
        return error
    for times in (0, 1):
        speed, true = (
            _average_seconds(measure_lengths(torch.diff(each, n=times, dim=1), _LEAST)) for each in (steps, wanted)
        )
        counts = _average_seconds(truthful[:, 1 + times :, None].float())[..., 0] > 0.999
        error = error + _average((speed - true).abs().mean(dim=-1), counts)
    return error


def _compute_path_terms(
    trajectory: RootTrajectory, generated: Tensor, sequences: KeySequences, some: slice
) -> dict[str, Tensor]:
    """Errors of where the hips of some sequences go, as the path predictor sees it, metres, and of contacts, nats."""
    motion, known, truthful = sequences.motion, sequences.known[some], sequences.truthful[some]
    hips, contacts = motion.root_position[some], motion.contacts[some]
    steps = truthful.float()
    errors = []
    for span in [span for span in _PATH_SPANS if span < steps.shape[1]]:
        whole = steps.unfold(1, span + 1, 1).amin(dim=-1)
        errors.append(_average(compute_displacement_errors(generated[..., ::2], hips[..., ::2], span), whole))
    height = _average((generated[..., 1] - hips[..., 1]).abs(), steps)
    placed = sequences.given.placed[some].float()
    share = placed / placed.sum(dim=1, keepdim=True).clamp_min(1)
    off = (generated - hips)[..., ::2]
    off = off - (off * share[..., None]).sum(dim=1, keepdim=True)
    nats = cross_entropy(trajectory.contacts, contacts, reduction="none").mean(dim=-1)
    return {
        "path": torch.stack(errors).mean() + height,
        "root": (measure_lengths(off, _LEAST) * share).sum(dim=1).mean(),
        "contacts": _average(nats, _weigh_frames(known) * truthful),
    }


def _compute_dwell_error(
    apart: Float[Tensor, "batch poses frames"], known: Bool[Tensor, "batch frames"], counts: Bool[Tensor, " batch"]
) -> Tensor:
    """How far those poses of each gap that come nearest to a pose of the style are from it, one for each 3 s and kept
    for some frames (Eq. 12), metres."""
    nearest = avg_pool1d(apart, _DWELL, stride=1).amin(dim=1)
    found = []
    for row in counts.nonzero()[:, 0].tolist():
        for _, start, stop in true_intervals(~known[row][:, None]):
            inside = nearest[row, start : max(start, stop - _DWELL + 1)]
            if poses := (stop - start) // _DNA_GAP:
                # Of each three seconds one: neighbours of the nearest are no pose more.
                found += [part.amin() for part in inside.tensor_split(poses)]
    return torch.stack(found).mean() if found else apart.new_zeros(())


def _weigh_frames(known: Bool[Tensor, "batch frames"]) -> Float[Tensor, "batch frames"]:
    """1 at a key, less the farther the nearest is."""
    frame = torch.arange(known.shape[1])
    away = torch.minimum((frame - last_observed(known)).abs(), (next_observed(known) - frame).abs())
    return 1 / (1 + away / _HALF)


def _average_seconds(values: Float[Tensor, "batch frames columns"]) -> Float[Tensor, "batch seconds columns"]:
    """Average over about a second each, without overlap."""
    return avg_pool1d(values.transpose(1, 2), _ACTIVITY_FRAMES).transpose(1, 2)


def _average(values: Tensor, weight: Tensor) -> Tensor:
    return (values * weight).sum() / weight.sum().clamp_min(1e-6)


def _set_moments(network: GeneratorNetwork, windows: PoseWindows) -> None:
    """Set means and spreads of the positions that the network sees along their heading, mirrored ones too."""
    batch = windows.draw(4000, 4, make_generator(0))
    local = batch.local_matrices()
    seen = see_from_hips(kinematics.positions_from_matrices(CANONICAL, local), local[..., 0, :, :])
    seen = seen + batch.root_position[..., None, :] * torch.tensor([0.0, 1.0, 0.0])
    positions = torch.cat([seen, mirror_positions(seen)]).flatten(0, 1)
    network.mean.copy_(positions.mean(dim=0))
    network.std.copy_(positions.std(dim=0).clamp_min(_MIN_STD))


def draw_style_poses(
    windows: PoseWindows, sequences: KeySequences, foreign: float, generator: torch.Generator
) -> Float[Tensor, "batch poses joints 3"]:
    """Draw poses anywhere in each sequence, or, of this share of them, in another clip: positions from the hips,
    metres, without the hips' rotation."""
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


CLIPS_OF_CLASS = 24
"""Clips of a class that its vector is the mean of, at most: evenly among all of them by name."""


def collect_dna(corpus: Corpus, labels: str = LABELS) -> Mapping[str, Sequence[Float[Tensor, "poses joints 3"]]]:
    """Collect the poses of clips by class; RequestError for labels of one's own that no clip has."""
    clips, found = corpus.clips(), dict[str, list[Tensor]]()
    for name, numbers in group_clips(corpus.names, labels).items():
        taken = min(len(numbers), CLIPS_OF_CLASS)
        poses = [BodyPose.of_features_in_place(clips[numbers[at * len(numbers) // taken]]) for at in range(taken)]
        quats = [rotations.from_rotation_vector(pose.rotation_vectors) for pose in poses]
        found[name] = [motion_dna.of_rotations(each) for each in quats]
    return found


def group_clips(names: Sequence[str], labels: str = LABELS) -> dict[str, list[int]]:
    """Group clips, by number, by class; RequestError for labels of one's own that no clip has."""
    members: dict[str, list[int]] = {}
    for number, name in enumerate(names):
        if (found := find_class(name, labels)) is not None:
            members.setdefault(found, []).append(number)
    if not members and labels != LABELS:
        raise RequestError(f"--labels {labels!r} matches no clip, such as {names[0]!r}")
    return members
