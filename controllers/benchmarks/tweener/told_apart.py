"""Benchmark of realism between keys of different clips (Zhou et al. 2020, table 4): which seconds without a key a
network tells from mocap's, and how often it rather takes the made one for mocap.
"""

from collections.abc import Callable, Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from controllers.benchmarks.shared.tables import Row
from controllers.benchmarks.tweener.gap_measures import Method
from controllers.benchmarks.tweener.spliced_keys import KeySequence
from mapctl.errors import RequestError
from mapctl.metrics.realism import RealismSettings, WindowSettings, cut_windows, measure_window_realism
from mapctl.motion import Motion

SHORTEST, LONGEST = 90, 480
"""Frames of the gaps that are judged: 3 to 16 s."""


def benchmark_told_apart(
    sequences: Sequence[KeySequence],
    mocap: Sequence[Motion],
    methods: Sequence[Method],
    *,
    settings: RealismSettings | None = None,
    seed: int = 0,
    progress: Callable[[int, int], None] | None = None,
) -> list[Row]:
    """Measure every method's seconds without a key in gaps between keys of different clips against mocap: balanced
    accuracy and preference of networks on clips and gaps that they did not learn from, and the Frechet distance. The
    first row is mocap against mocap. Clips are `mocap` by the number that keys have; it is drawn from those that the
    keys of each gap are of, as many windows as the gap has. RequestError for fewer than 8 gaps or clips.
    """
    settings = settings or RealismSettings()
    judged = [(number, gap) for number, each in enumerate(sequences) for gap in find_spliced_gaps(each)]
    shown = _cut_mocap(sequences, judged, mocap, settings.windows, torch.Generator().manual_seed(seed))
    if min(len(judged), len(shown)) < settings.min_clips:
        raise RequestError(
            f"too few to be told apart: {len(judged)} gaps and {len(shown)} clips of a second and more, it takes"
            f" {settings.min_clips} of each; ask for more --sequences"
        )
    rows: list[Row] = []
    for number, method in enumerate(methods):
        filled = [sequence.fill(method).joint_positions() for sequence in sequences]
        made = [cut_windows(filled[row][start:stop], settings.windows) for row, (start, stop) in judged]
        generator = torch.Generator().manual_seed(seed)
        found = measure_window_realism(made, shown, generator=generator, settings=settings)
        if not rows:
            rows.append(
                _row("mocap", found.mocap_windows, found.floor_accuracy, found.floor_preferred, found.floor_frechet)
            )
        rows.append(_row(method.name, found.made_windows, found.accuracy, found.preferred, found.frechet))
        if progress is not None:
            progress(number + 1, len(methods))
    return rows


def find_spliced_gaps(sequence: KeySequence) -> list[tuple[int, int]]:
    """Return gaps of a sequence between keys of different clips, of the lengths that are judged."""
    return [
        (start, stop)
        for start, stop in sequence.gaps()
        if SHORTEST <= stop - start <= LONGEST and sequence.clip[start - 1] != sequence.clip[stop]
    ]


def _cut_mocap(
    sequences: Sequence[KeySequence],
    judged: Sequence[tuple[int, tuple[int, int]]],
    mocap: Sequence[Motion],
    settings: WindowSettings,
    generator: torch.Generator,
) -> list[Float[Tensor, "windows frames channels"]]:
    """Draw windows of the clips that the keys around gaps are of, for each of the two half as many as the gap has; all
    of one clip together. Clips that are shorter than a window are left out."""
    drawn: dict[int, list[Tensor]] = {}
    for number, (start, stop) in judged:
        wanted = (stop - start - settings.frames + settings.step - 1) // settings.step
        for clip in sequences[number].clip[[start - 1, stop]].tolist():
            if mocap[clip].num_frames > settings.frames:
                windows = cut_windows(mocap[clip].joint_positions(), settings)
                picked = torch.randint(len(windows), ((wanted + 1) // 2,), generator=generator)
                drawn.setdefault(clip, []).append(windows[picked])
    return [torch.cat(drawn[clip]) for clip in sorted(drawn)]


def _row(name: str, windows: int, accuracy: float, preferred: float, frechet: float) -> Row:
    return {"by": name, "windows": windows, "told_apart": accuracy, "preferred": preferred, "frechet": frechet}
