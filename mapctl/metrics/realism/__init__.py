"""Realism without users: can a network tell made motion from mocap, and how far apart are they?

Every number comes with its floor: what mocap shows against mocap.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import torch
from torch import Tensor

from mapctl.errors import RequestError
from mapctl.metrics.realism.classifier import ClassifierSettings, compute_held_out_accuracy
from mapctl.metrics.realism.diversity import Diversity, average_pairwise_distance, measure_diversity
from mapctl.metrics.realism.frechet import Basis, frechet_distance
from mapctl.metrics.realism.gait import GaitSpread, measure_gait_spread
from mapctl.metrics.realism.windows import WindowSettings, canonical_positions, cut_windows
from mapctl.motion import Motion
from mapctl.runtime.progress import Progress

__all__ = [
    "ClassifierSettings",
    "Diversity",
    "GaitSpread",
    "Realism",
    "RealismSettings",
    "WindowSettings",
    "average_pairwise_distance",
    "canonical_positions",
    "cut_windows",
    "measure_diversity",
    "measure_gait_spread",
    "measure_realism",
    "measure_window_realism",
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
    _check_counts(len(made), len(mocap), settings)
    seeds = torch.randint(2**62, (2,), generator=generator).tolist()
    shuffled, ours = (torch.Generator().manual_seed(seed) for seed in seeds)
    order = torch.randperm(len(mocap), generator=shuffled).tolist()
    halves = [[mocap[i] for i in half] for half in (order[::2], order[1::2])]
    tick = _make_tick(progress, 2 * settings.classifier.folds)
    floor, accuracy = (
        compute_held_out_accuracy(*sets, generator=drawn, settings=settings.classifier, tick=tick)
        for sets, drawn in ((halves, shuffled), ((made, mocap), ours))
    )
    basis = Basis.of(torch.cat(list(mocap)), settings.dims)
    points = [basis.project(torch.cat(list(clips))) for clips in (made, mocap, *halves)]
    return Realism(
        accuracy,
        floor,
        frechet_distance(points[0], points[1]),
        frechet_distance(points[2], points[3]),
        made_windows=len(points[0]),
        mocap_windows=len(points[1]),
    )


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
