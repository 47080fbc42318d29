"""Folders of clips as sets to compare: read whole, with the offending file named where one will not do."""

import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from mapctl import formats, metrics, retarget
from mapctl.errors import MapctlError, RequestError
from mapctl.features import PRIOR_FPS
from mapctl.metrics import realism
from mapctl.metrics.realism.diversity import diversity_of_positions, from_own_start
from mapctl.metrics.realism.gait import PIECE_SECONDS
from mapctl.motion import Motion
from mapctl.progress import bar

SETTINGS = realism.RealismSettings()
"""How folders are told apart."""


@dataclass(frozen=True, eq=False)
class ClipSet:
    """Every clip below a folder, in the order of their paths."""

    folder: Path
    """Where they lie."""
    motions: list[Motion]
    """On canonical joints, so that sets on different rigs compare; as in the files where the rig is not known."""
    means: dict[str, float]
    """Mean of each measure over the clips that can give it."""
    positions: list[Tensor]
    """Canonical joints of each clip, (frames, joints, 3); none unless read with windows."""
    windows: list[Tensor]
    """Windows of each clip, (windows, frames, channels); none unless read with windows."""

    @staticmethod
    def read(folder: Path, *, with_windows: bool) -> "ClipSet":
        """Read and measure; MapctlError names the file that cannot be read, measured or cut into windows."""
        paths = sorted(p for p in folder.rglob("*") if p.suffix.lower() in formats.READERS and p.is_file())
        if not paths:
            raise RequestError(f"{folder}: no {' or '.join(formats.READERS)} file in this folder or below it")
        motions, rows, positions, windows = [], [], [], []
        with bar(f"reading {folder}") as progress:
            for number, path in enumerate(paths, start=1):
                loaded = formats.load(path)
                with _named(path):
                    motions.append(_canonical(loaded))
                    rows.append(metrics.measure(motions[-1]))
                    if with_windows:
                        positions.append(realism.canonical_positions(motions[-1]))
                        windows.append(realism.clip_windows(positions[-1], SETTINGS.windows))
                if progress is not None:
                    progress(number, len(paths))
        return ClipSet(folder, motions, _means(rows), positions, windows)

    def diversity(self) -> realism.Diversity:
        """Of the first 3 s of the clips; NaN for fewer than two clips of 3 s.

        Each clip is seen from its own start, so that sets which did not begin in one place can be compared.
        """
        frames = round(PIECE_SECONDS * PRIOR_FPS)
        pieces = [from_own_start(clip)[:frames] for clip in self.positions if len(clip) >= frames]
        if len(pieces) < 2:
            return realism.Diversity(math.nan, math.nan)
        return diversity_of_positions(torch.stack(pieces))


def compared_realism(ours: ClipSet, reference: ClipSet, *, seed: int) -> realism.Realism:
    """Ours against the reference; RequestError, which says what is left to do, for too few clips."""
    fewest = SETTINGS.fewest_clips
    for clips in (ours, reference):
        if len(clips.motions) < fewest:
            raise RequestError(f"{clips.folder}: {len(clips.motions)} clips; a comparison needs at least {fewest} in "
                               "each folder (without --reference a folder of any size is measured)")  # fmt: skip
    draws = torch.Generator().manual_seed(seed)
    with bar("telling apart") as progress:
        return realism.realism_of_windows(
            ours.windows, reference.windows, generator=draws, settings=SETTINGS, progress=progress
        )


def compared_spread(ours: ClipSet, reference: ClipSet) -> dict[str, dict[str, float]]:
    """By measure ours, the reference's and their ratio: standard deviations of gait, average pairwise distances."""
    sides = []
    for clips in (ours, reference):
        gait = {f"std_of_{name}": spread.std for name, spread in realism.gait_spread(clips.motions).items()}
        apart = clips.diversity()
        sides.append(gait | {f"pairwise_distance_{name}": value for name, value in apart._asdict().items()})
    mine, theirs = sides
    return {
        name: {"ours": value, "reference": theirs[name], "ratio": value / theirs[name] if theirs[name] else math.nan}
        for name, value in mine.items()
    }


def _canonical(motion: Motion) -> Motion:
    try:
        return retarget.to_canonical(motion)[0]
    except RequestError:
        return motion


@contextmanager
def _named(path: Path) -> Iterator[None]:
    """Errors within name the file."""
    try:
        yield
    except MapctlError as error:
        raise RequestError(f"{path}: {error}") from error


def _means(rows: list[dict[str, float]]) -> dict[str, float]:
    """NaN, a clip that cannot give a measure, is left out."""
    return {name: float(torch.tensor([row[name] for row in rows], dtype=torch.float64).nanmean()) for name in rows[0]}
