"""Folders of clips as sets to compare: read whole, with the files listed that cannot be used."""

import math
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from mapctl import formats, metrics
from mapctl.commands.shared.inputs import read_motion
from mapctl.commands.shared.progress_bar import show_progress
from mapctl.errors import MapctlError, RequestError
from mapctl.features import PRIOR_FPS
from mapctl.metrics import realism
from mapctl.metrics.comparison import make_comparable
from mapctl.metrics.realism.diversity import align_to_start, measure_position_diversity
from mapctl.metrics.realism.gait import PIECE_SECONDS
from mapctl.motion import Motion
from mapctl.retarget.rigs import Rig

SETTINGS = realism.RealismSettings()
"""Settings of the classifier of two folders."""


@dataclass(frozen=True, eq=False)
class _MeasuredClip:
    """One measured file of a folder."""

    path: Path
    """The file."""
    motion: Motion
    """Motion made comparable."""
    measures: dict[str, float]
    """Measures by name."""
    positions: Tensor
    """Positions of canonical joints, (frames, joints, 3), metres; empty unless read with windows."""
    windows: Tensor
    """Windows, (windows, frames, channels); empty unless read with windows."""
    notes: list[str]
    """Notes on what could not be made comparable."""

    @staticmethod
    def read(path: Path, *, with_windows: bool, rig: Rig | None) -> "_MeasuredClip":
        """Read and measure a file; MapctlError for what cannot be read, measured or cut."""
        motion, notes = make_comparable(read_motion(path, rig), rig)
        measures, positions, windows = metrics.measure(motion), torch.zeros(0), torch.zeros(0)
        if with_windows:
            positions = realism.canonical_positions(motion)
            windows = realism.cut_windows(positions, SETTINGS.windows)
        return _MeasuredClip(path, motion, measures, positions, windows, [f"{path}: {note}" for note in notes])


@dataclass(frozen=True, eq=False)
class ClipSet:
    """Every clip below a folder, in the order of their paths."""

    folder: Path
    """Folder of the clips."""
    names: list[str]
    """Path of each clip below the folder."""
    motions: list[Motion]
    """Motions on canonical joints and at 30 frames/s at most, so that sets on different rigs compare (see
    `metrics.comparison`)."""
    means: dict[str, float]
    """Mean of each measure over the clips that can give it."""
    positions: list[Tensor]
    """Canonical joints of each clip, (frames, joints, 3); none unless read with windows."""
    windows: list[Tensor]
    """Windows of each clip, (windows, frames, channels); none unless read with windows."""
    skipped: dict[str, str]
    """Reasons by file that was left out, each a sentence that begins with the file."""
    notes: tuple[str, ...] = ()
    """Notes on what could not be made comparable."""

    @staticmethod
    def read(folder: Path, *, with_windows: bool, rig: Rig | None = None) -> "ClipSet":
        """Read and measure clips of a rig. A file that cannot be read, measured or cut into windows is left out;
        RequestError if none can."""
        paths = sorted(p for p in folder.rglob("*") if p.suffix.lower() in formats.READERS and p.is_file())
        if not paths:
            raise RequestError(f"{folder}: no {' or '.join(formats.READERS)} file in this folder or below it")
        clips: list[_MeasuredClip] = []
        skipped: dict[str, str] = {}
        with show_progress(f"reading {folder}") as progress:
            for number, path in enumerate(paths, start=1):
                try:
                    clips.append(_MeasuredClip.read(path, with_windows=with_windows, rig=rig))
                except MapctlError as error:
                    skipped[str(path)] = str(error) if str(error).startswith(str(path)) else f"{path}: {error}"
                if progress is not None:
                    progress(number, len(paths))
        if not clips:
            raise RequestError(f"{folder}: no clip can be measured; {next(iter(skipped.values()))}")
        positions, windows = [c.positions for c in clips if with_windows], [c.windows for c in clips if with_windows]
        return ClipSet(
            folder,
            [clip.path.relative_to(folder).as_posix() for clip in clips],
            [clip.motion for clip in clips],
            _average_measures([clip.measures for clip in clips]),
            positions,
            windows,
            skipped,
            tuple(note for clip in clips for note in clip.notes),
        )

    def diversity(self) -> realism.Diversity:
        """Measure the diversity of the first 3 s of the clips; NaN for fewer than two clips of 3 s.

        Each clip is aligned to its own start, so that sets with different starts can be compared.
        """
        frames = round(PIECE_SECONDS * PRIOR_FPS)
        pieces = [align_to_start(clip)[:frames] for clip in self.positions if len(clip) >= frames]
        if len(pieces) < 2:
            return realism.Diversity(math.nan, math.nan)
        return measure_position_diversity(torch.stack(pieces))


def train_judges(ours: ClipSet, reference: ClipSet) -> realism.Judges:
    """Train networks that distinguish ours from the reference's; RequestError for too few clips."""
    fewest = SETTINGS.min_clips
    for clips in (ours, reference):
        if len(clips.motions) < fewest:
            raise RequestError(
                f"{clips.folder}: {len(clips.motions)} clips; a comparison needs at least {fewest} in each folder"
                f"{_describe_skipped(clips)} (without --reference a folder of any size is measured)"
            )
    generator = torch.Generator().manual_seed(0)
    with show_progress("telling apart") as progress:
        return realism.train_judges(
            ours.windows, reference.windows, generator=generator, settings=SETTINGS, progress=progress
        )


def compare_variability(ours: ClipSet, reference: ClipSet) -> dict[str, dict[str, float]]:
    """Compare ours and the reference's by measure: standard deviations of gait, average pairwise distances."""
    sides = []
    for clips in (ours, reference):
        gait = {f"std_of_{name}": spread.std for name, spread in realism.measure_gait_spread(clips.motions).items()}
        diversity = clips.diversity()
        sides.append(gait | {f"pairwise_distance_{name}": value for name, value in diversity._asdict().items()})
    mine, theirs = sides
    return {
        name: {"ours": value, "reference": theirs[name], "ratio": value / theirs[name] if theirs[name] else math.nan}
        for name, value in mine.items()
    }


def _describe_skipped(clips: ClipSet) -> str:
    first = next(iter(clips.skipped.values()), None)
    return "" if first is None else f", and {len(clips.skipped)} cannot be measured: {first}"


def _average_measures(rows: list[dict[str, float]]) -> dict[str, float]:
    """Average each measure over the clips that can give it, which are not NaN."""
    return {name: float(torch.tensor([row[name] for row in rows], dtype=torch.float64).nanmean()) for name in rows[0]}
