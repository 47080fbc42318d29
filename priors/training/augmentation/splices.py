"""Splices: pieces of two clips and the stitcher's way between them, where each clip holds one thing done.

A density of such clips goes on with whatever it does: nothing shows it that who waves may walk off. Clips that begin or
stop going, change between a walk and a run, or do something else, are made by the stitcher (Ren et al. 2024) and kept
where they pass for mocap.
"""

import json
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from hashlib import sha256
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from mapctl import metrics, rotations
from mapctl.errors import RequestError
from mapctl.features import LAYOUT, PRIOR_FPS, GroundPose, reversed_features
from mapctl.joint_roles import find_feet, find_hips
from mapctl.metrics.gait import GOES, RUNS, STANDS, WALKS
from mapctl.metrics.worst_frame import measure_longest_unsupported, measure_peaks
from mapctl.motion import Motion
from mapctl.pose import decode
from mapctl.runtime.stepwise import StepwiseWork
from priors.checkpoints import compute_hash
from priors.stitching.inbetweener import MAX_CONTEXT, Stitcher, load
from priors.training.corpus import Corpus, measure_speeds, read_cache, write_cache

CHECKED = (
    "contact_speed_cm_s",
    "penetration_cm",
    "jitter_m_s3",
    "largest_step_cm",
    "largest_acceleration_m_s2",
    "longest_slide_s",
)
"""Mean speed of planted toes, depth under the floor, mean jerk; over all joints and frames the largest step about the
hips in a thirtieth of a second, and the largest acceleration; and for how long the body goes while no low toe
stands."""
_RANGE = 95.0  # percentile over the reference's clips that no made clip may exceed
_LEAST_FRAMES = 30  # of a clip that says something


def measure_checked(motion: Motion) -> dict[str, float]:
    """The measures of CHECKED of a motion."""
    found, places = metrics.measure(motion), motion.joint_positions()
    hips, toes = places[:, find_hips(motion.skeleton)], places[:, list(find_feet(motion.skeleton))]
    fps = float(motion.fps)
    peaks = measure_peaks(places, hips, fps)
    own = {
        "largest_step_cm": 100 * peaks.step,
        "largest_acceleration_m_s2": peaks.acceleration,
        "longest_slide_s": measure_longest_unsupported(toes, hips, fps),
    }
    return {name: own.get(name, found.get(name, math.nan)) for name in CHECKED}


def find_bounds(reference: Iterable[Motion]) -> dict[str, float]:
    """By measure what 95 % of the clips stay under; clips of less than a second say nothing."""
    rows = [measure_checked(motion) for motion in reference if motion.num_frames >= _LEAST_FRAMES]
    return {name: float(np.nanpercentile([row[name] for row in rows], _RANGE)) for name in CHECKED if rows}


def list_faults(measures: Mapping[str, float], bounds: Mapping[str, float]) -> list[str]:
    """By how much measures exceed the bounds, in words; what cannot be measured, as of feet that never stand, is a
    fault."""
    return [
        f"{name} {measures[name]:.3g}, allowed are {bound:.3g}"
        for name, bound in bounds.items()
        if not measures[name] <= bound
    ]


FOLDER = "spliced/"
"""Before the names of splices in a corpus, which are those of both clips."""
_STANDING, _GOING, _WALKING, _RUNNING = (0.0, STANDS), (GOES, math.inf), (GOES, WALKS), (RUNS, math.inf)
_KINDS = (
    (_STANDING, _GOING),
    (_GOING, _STANDING),
    (_STANDING, _STANDING),
    # Twice as often, since fewer of them pass for mocap.
    *(2 * ((_WALKING, _RUNNING), (_RUNNING, _WALKING))),
)
"""Who sets off, who stops, who stands and does something else, who begins to run, who slows down to a walk: the
smoothed speeds, m/s, between which the first piece ends and the second begins."""
_PIECE = 45, 120  # frames of a piece
_GAPS = range(15, 60, 5)  # frames between two: few lengths, each of which is walked at once
_GAP_A_SPEED = 12.0  # frames by which a gap is longer for each m/s of difference
_TURN = 0.5  # standard deviation of the turn between two pieces, radians
_REFERENCE = 300  # clips whose measures bound those of the splices of one kind
_AT_ONCE = 64  # splices that are walked at once
_VELOCITY_FRAMES = 5  # frames over which the velocity at a cut is estimated


@dataclass(frozen=True)
class Splices:
    """How many splices are made beside the clips, and by which stitcher."""

    count: int = 0
    """Splices that are tried; those that do not pass for mocap are left out."""
    stitcher: str = "stitcher"
    """The bundled one, or the file or run folder of a trained one."""
    seed: int = 1
    """Of the cuts, and of what the stitcher draws."""

    def __post_init__(self):
        if self.count < 0:
            raise RequestError(f"--splices must be 0 or more, got {self.count}")


@dataclass(frozen=True)
class Cut:
    """Where a splice goes from one clip to another."""

    clips: tuple[int, int]
    """Numbers of the first and the second clip."""
    first: slice
    """Frames of the first clip, up to the last before the gap."""
    second: slice
    """Frames of the second clip, from the first after the gap on."""
    gap: int
    """Frames between the two."""
    turn: float
    """Of the heading from the one to the other, radians."""
    kind: tuple[tuple[float, float], tuple[float, float]]
    """Speeds, m/s, between which the first piece ends, and between which the second begins."""


def add_splices(corpus: Corpus, splices: Splices, cache: Path | None = None) -> Corpus:
    """Return a corpus with its clips, and after them the splices of them that no measure tells from them, by names that
    begin with FOLDER. In the folder `cache` they are kept: a run that is resumed reads them.

    Who stands sets off, who goes stops, and who stands does something else, as often each where the clips have it, and
    twice as often who walks begins to run, and who runs slows down to a walk; the second piece begins where velocities
    of both lead. RequestError for a corpus with nothing of it, CheckpointError for a stitcher that is none.
    """
    if splices.count == 0:
        return corpus
    stitcher = load(splices.stitcher)
    stored = cache / f"splices-{_compute_cache_key(corpus, splices)}.safetensors" if cache else None
    kept = read_cache(stored) if stored else None
    if kept is None:
        kept = _make_splices(corpus, splices, stitcher)
        if stored:
            write_cache(kept, stored)
    return replace(
        corpus,
        names=corpus.names + kept.names,
        lengths=corpus.lengths + kept.lengths,
        features=torch.cat([corpus.features, kept.features]),
    )


def _compute_cache_key(corpus: Corpus, splices: Splices) -> str:
    parts = {**corpus.identity(), **asdict(splices), "stitcher": compute_hash(splices.stitcher)}
    return sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()[:16]


def _make_splices(corpus: Corpus, splices: Splices, stitcher: Stitcher) -> Corpus:
    """Make those that pass for mocap, without the clips."""
    clips, generator = corpus.clips(), torch.Generator().manual_seed(splices.seed)
    gaps = [gap for gap in _GAPS if gap <= stitcher.longest] or [stitcher.longest]
    cuts = draw_cuts(corpus, splices.count, gaps, generator)
    spliced = _walk_all(clips, cuts, stitcher, generator)
    bounds = {kind: _bound(clips, [cut for cut in cuts if cut.kind == kind]) for kind in {cut.kind for cut in cuts}}
    kept = [number for number, features in enumerate(spliced) if _passes(features, bounds[cuts[number].kind])]
    return Corpus(
        tuple(FOLDER + " + ".join(corpus.names[clip] for clip in cuts[number].clips) for number in kept),
        tuple(len(spliced[number]) for number in kept),
        torch.cat([corpus.features[:0], *(spliced[number] for number in kept)]),
    )


def _bound(clips: Sequence[Tensor], cuts: Sequence[Cut]) -> dict[str, float]:
    """Bound the measures of splices of one kind by the clips they are of: who runs steps further than who stands."""
    numbers = sorted({number for cut in cuts for number in cut.clips})
    spread = numbers[:: math.ceil(len(numbers) / _REFERENCE)]
    return find_bounds(decode(clips[number], GroundPose.origin()) for number in spread)


def drop_splices(corpus: Corpus) -> Corpus:
    """Return a corpus without its splices."""
    return corpus.subset(number for number, name in enumerate(corpus.names) if not name.startswith(FOLDER))


def hide_splices(names: Sequence[str]) -> list[str]:
    """Hide the names of splices, from which labels would be read that hold for one of the two clips alone."""
    return ["" if name.startswith(FOLDER) else name for name in names]


def draw_cuts(corpus: Corpus, count: int, gaps: Sequence[int], generator: torch.Generator) -> list[Cut]:
    """Draw where pieces of two clips are cut, of each kind in turn, and which of the gaps lies between; RequestError
    for a corpus in which nobody stands, or both walks and runs, for a piece."""
    speeds = measure_speeds(corpus)
    ends = {speed: _find_frames(speeds, speed, lead=_PIECE[0]) for speed in {a for a, _ in _KINDS}}
    beginnings = {speed: _find_frames(speeds, speed, rest=_PIECE[0]) for speed in {b for _, b in _KINDS}}
    kinds = [(a, b) for a, b in _KINDS if len(ends[a]) and len(beginnings[b])]
    if not kinds:
        raise RequestError(
            f"splices need clips of {_PIECE[0] / PRIOR_FPS:g} s in which somebody stands, or both walks and runs"
        )

    def pick(frames: Tensor) -> tuple[int, int]:
        clip, frame = frames[int(torch.randint(len(frames), (), generator=generator))].tolist()
        return clip, frame

    cuts = []
    for number in range(count):
        kind = a, b = kinds[number % len(kinds)]
        (one, last), (other, first) = pick(ends[a]), pick(beginnings[b])
        lengths = torch.randint(_PIECE[0], _PIECE[1] + 1, (2,), generator=generator).tolist()
        change = abs(float(speeds[one][last] - speeds[other][first]))
        wanted = _GAPS[0] + _GAP_A_SPEED * change + float(torch.rand((), generator=generator)) * _GAPS[0]
        cuts.append(
            Cut(
                (one, other),
                slice(max(0, last + 1 - lengths[0]), last + 1),
                slice(first, first + lengths[1]),
                min(gaps, key=lambda gap: abs(gap - wanted)),
                _TURN * float(torch.randn((), generator=generator)),
                kind,
            )
        )
    return cuts


def _find_frames(
    speeds: Sequence[Tensor], wanted: tuple[float, float], *, lead: int = 1, rest: int = 0
) -> Int[Tensor, "found 2"]:
    """Clip and frame of all frames whose speed lies between those wanted, m/s, with so many frames up to it and so many
    after it."""
    found = [torch.empty(0, 2, dtype=torch.long)]
    for clip, speed in enumerate(speeds):
        frames = torch.arange(lead - 1, max(lead - 1, len(speed) - rest))
        frames = frames[(wanted[0] <= speed[frames]) & (speed[frames] < wanted[1])]
        found.append(torch.stack([torch.full_like(frames, clip), frames], dim=1))
    return torch.cat(found)


def _walk_all(
    clips: Sequence[Tensor], cuts: Sequence[Cut], stitcher: Stitcher, generator: torch.Generator
) -> list[Float[Tensor, "frames size"]]:
    """The splices of all cuts, those with one length of gap together."""
    spliced: dict[int, Tensor] = {}
    for gap in sorted({cut.gap for cut in cuts}):
        numbers = [number for number, cut in enumerate(cuts) if cut.gap == gap]
        for begin in range(0, len(numbers), _AT_ONCE):
            part = numbers[begin : begin + _AT_ONCE]
            walked = _walk(clips, [cuts[number] for number in part], stitcher, generator)
            spliced |= dict(zip(part, walked, strict=True))
    return [spliced[number] for number in range(len(cuts))]


def _walk(
    clips: Sequence[Tensor], cuts: Sequence[Cut], stitcher: Stitcher, generator: torch.Generator
) -> list[Float[Tensor, "frames size"]]:
    """The splices of cuts with one length of gap."""
    frames, context = cuts[0].gap + 1, MAX_CONTEXT + 2
    first = [clips[cut.clips[0]][cut.first] for cut in cuts]
    second = [clips[cut.clips[1]][cut.second] for cut in cuts]
    before = torch.stack([piece[-context:] for piece in first])
    after = torch.stack([piece[:context] for piece in second])
    turn = torch.tensor([cut.turn for cut in cuts])
    leaving, arriving = (
        _average_velocity(before[:, -_VELOCITY_FRAMES:]),
        _average_velocity(after[:, 1 : 1 + _VELOCITY_FRAMES]),
    )
    place = frames / 2 * (leaving + rotations.rotate_ground(arriving, turn))
    ways = StepwiseWork(
        stitcher.connect(before, reversed_features(after), place, turn, frames, noise=generator)
    ).finish()
    return [torch.cat([one, way, other[1:]]) for one, way, other in zip(first, ways, second, strict=True)]


def _average_velocity(features: Float[Tensor, "batch frames size"]) -> Float[Tensor, "batch 2"]:
    """Over the ground at a cut, metres a frame, in the headings of its frames."""
    return LAYOUT.pick(features, "root_displacement_heading").mean(dim=1)


def _passes(features: Float[Tensor, "frames size"], bounds: Mapping[str, float]) -> bool:
    if not bool(torch.isfinite(features).all()):
        return False
    return not list_faults(measure_checked(decode(features, GroundPose.origin())), bounds)
