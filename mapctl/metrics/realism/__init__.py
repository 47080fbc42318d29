"""Realism without users: can a network tell made motion from mocap, and how far apart are they?

Every number comes with its floor: what mocap shows against mocap.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import torch
from torch import Tensor

from mapctl.errors import RequestError
from mapctl.metrics.realism.classifier import (
    ClassifierSettings,
    HeldOutFold,
    HeldOutVerdict,
    average_verdicts,
    judge_folds,
    judge_held_out,
)
from mapctl.metrics.realism.diversity import Diversity, average_pairwise_distance, measure_diversity
from mapctl.metrics.realism.frechet import Basis, frechet_distance
from mapctl.metrics.realism.gait import GaitSpread, measure_gait_spread, spread_ratios
from mapctl.metrics.realism.windows import WindowSettings, canonical_positions, cut_windows
from mapctl.motion import Motion
from mapctl.runtime.progress import Progress

__all__ = [
    "ClassifierSettings",
    "Diversity",
    "GaitSpread",
    "HeldOutVerdict",
    "Judges",
    "Realism",
    "RealismSettings",
    "WindowSettings",
    "average_pairwise_distance",
    "canonical_positions",
    "cut_windows",
    "judge_held_out",
    "measure_diversity",
    "measure_gait_spread",
    "measure_realism",
    "measure_window_realism",
    "spread_ratios",
    "train_judges",
]


@dataclass(frozen=True)
class RealismSettings:
    """Settings of a realism measurement."""

    windows: WindowSettings = field(default_factory=WindowSettings)
    """Settings of the windows that clips are cut into."""
    classifier: ClassifierSettings = field(default_factory=ClassifierSettings)
    """Settings of the network that tells the sets apart."""
    dims: int = 32
    """Number of principal components of mocap's windows in which the Frechet distance is taken."""

    def __post_init__(self):
        if self.dims < 1:
            raise RequestError(f"dims must be at least 1, got {self.dims}")

    @property
    def min_clips(self) -> int:
        """Number of clips that each set needs, so that half of the mocap still has one for every fold."""
        return 2 * self.classifier.folds


@dataclass(frozen=True)
class Realism:
    """How made motion compares with mocap."""

    accuracy: float
    """Balanced held-out accuracy of the network, made against mocap, a share: 0.5 is perfect, 1 is told apart every
    time."""
    floor_accuracy: float
    """Balanced held-out accuracy of the network, one half of the mocap's clips against the other, a share likewise."""
    preferred: float
    """Share of pairs of a made and a mocap window in which the network rather takes the made one for mocap."""
    floor_preferred: float
    """The same share for the halves of the mocap."""
    frechet: float
    """Frechet distance of made windows to mocap's, no unit: coordinates are in mocap's standard deviations."""
    floor_frechet: float
    """Frechet distance between the halves, in the same coordinates without unit; halves are smaller sets, which adds to
    it."""
    made_windows: int
    """Number of windows of the made clips."""
    mocap_windows: int
    """Number of windows of the mocap clips."""


def measure_realism(
    made: Sequence[Motion],
    mocap: Sequence[Motion],
    *,
    generator: torch.Generator,
    settings: RealismSettings = RealismSettings(),
    progress: Progress | None = None,
) -> Realism:
    """Compare made clips with mocap, both of any known rig and frame rate; half a minute on one core.

    The floor's halves are every other clip of one shuffle that the generator draws: neither style nor length is
    balanced between them, so a small set's floor scatters around 0.5 from seed to seed. It does not depend on `made`.
    Sets should hold the same kinds of motion, or the network learns to tell the kinds apart. RequestError for fewer
    than 8 clips in a set, clips shorter than a window (31 frames at 30 fps), and rigs that are not known.
    """
    _check_counts(len(made), len(mocap), settings)
    sets = [_cut_clips(clips, name, settings.windows) for name, clips in (("made", made), ("mocap", mocap))]
    return measure_window_realism(*sets, generator=generator, settings=settings, progress=progress)


def measure_window_realism(
    made: Sequence[Tensor],
    mocap: Sequence[Tensor],
    *,
    generator: torch.Generator,
    settings: RealismSettings = RealismSettings(),
    progress: Progress | None = None,
) -> Realism:
    """Measure realism from `cut_windows` of each clip, (windows, frames, channels); RequestError for too few clips."""
    return train_judges(made, mocap, generator=generator, settings=settings, progress=progress).summarise()


@dataclass(frozen=True, eq=False)
class Judges:
    """Networks trained to tell made windows from mocap's, and one half of mocap's clips from the other."""

    made: Sequence[Tensor]
    """Windows of each made clip, (windows, frames, channels)."""
    mocap: Sequence[Tensor]
    """Windows of each mocap clip."""
    halves: tuple[list[int], list[int]]
    """Indices of the mocap clips in either half."""
    folds: Sequence[HeldOutFold]
    """Networks that tell made (first) from mocap."""
    floor_folds: Sequence[HeldOutFold]
    """Networks that tell the halves apart."""
    settings: RealismSettings
    """Settings of their training."""

    def summarise(self) -> Realism:
        """Compute the figures of realism."""
        verdict, floor = average_verdicts(self.folds), average_verdicts(self.floor_folds)
        halves = [[self.mocap[i] for i in half] for half in self.halves]
        basis = Basis.of(torch.cat(list(self.mocap)), self.settings.dims)
        points = [basis.project(torch.cat(list(clips))) for clips in (self.made, self.mocap, *halves)]
        return Realism(
            verdict.accuracy,
            floor.accuracy,
            verdict.preferred,
            floor.preferred,
            frechet_distance(points[0], points[1]),
            frechet_distance(points[2], points[3]),
            made_windows=len(points[0]),
            mocap_windows=len(points[1]),
        )


def train_judges(
    made: Sequence[Tensor],
    mocap: Sequence[Tensor],
    *,
    generator: torch.Generator,
    settings: RealismSettings = RealismSettings(),
    paired: bool = False,
    progress: Progress | None = None,
) -> Judges:
    """Train networks on `cut_windows` of each clip, (windows, frames, channels). `paired`: made and mocap clips of the
    same number belong together, and no network sees one of those that it judges the other of. RequestError for too few
    clips, and for pairs of which one is missing."""
    _check_counts(len(made), len(mocap), settings)
    seeds = torch.randint(2**62, (2,), generator=generator).tolist()
    shuffled, ours = (torch.Generator().manual_seed(seed) for seed in seeds)
    order = torch.randperm(len(mocap), generator=shuffled).tolist()
    halves = order[::2], order[1::2]
    tick = _make_tick(progress, 2 * settings.classifier.folds)
    folds: list[list[HeldOutFold]] = []
    first, second = ([mocap[i] for i in half] for half in halves)
    for sets, drawn, held in (((first, second), shuffled, False), ((made, mocap), ours, paired)):
        folds.append([])
        for fold in judge_folds(*sets, generator=drawn, settings=settings.classifier, paired=held):
            folds[-1].append(fold)
            tick()
    return Judges(made, mocap, halves, folds[1], folds[0], settings)


def _check_counts(made: int, mocap: int, settings: RealismSettings) -> None:
    if min(made, mocap) < settings.min_clips:
        raise RequestError(
            f"realism needs at least {settings.min_clips} clips of each, made and mocap; got {made} and {mocap}"
        )


def _cut_clips(clips: Sequence[Motion], name: str, settings: WindowSettings) -> list[Tensor]:
    windows = []
    for number, clip in enumerate(clips, start=1):
        try:
            windows.append(cut_windows(canonical_positions(clip), settings))
        except RequestError as error:
            raise RequestError(f"{name} clip {number} of {len(clips)}: {error}") from error
    return windows


def _make_tick(progress: Progress | None, total: int) -> Callable[[], None]:
    done = iter(range(1, total + 1))

    def tick() -> None:
        if progress is not None:
            progress(next(done), total)

    return tick
