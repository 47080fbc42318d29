"""Evidence of every fold of a comparison, gathered over the windows that its network did not see."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from mapctl.metrics.realism.classifier import HeldOutFold, score
from mapctl.metrics.realism.evidence.kinds import classify_gaits, find_foot_phases
from mapctl.metrics.realism.evidence.parts import cut_parts, join_parts
from mapctl.metrics.realism.evidence.paths import PathEvidence, exchange_groups, find_nearest, gather_evidence
from mapctl.metrics.realism.evidence.rows import Rows, average_tables, join_rows, take_rows
from mapctl.metrics.realism.frechet import Basis
from mapctl.metrics.realism.windows import WindowSettings, find_window_frames

_DIMS = 32  # principal components in which windows of the other set are near


@dataclass(frozen=True)
class EvidenceSettings:
    """Settings of how evidence is gathered."""

    windows: int = 400
    """Held-out windows of either set in each fold that are looked into, evenly spaced, at most."""
    partners: int = 2
    """Nearest windows of the other set that each is compared with."""
    steps: int = 8
    """Points of the way between the two where the gradient is taken."""
    moments: int = 10
    """Moments that are listed, at most."""
    alone_steps: int = 0
    """Training steps of networks that are given one group alone; 0 leaves them out."""


@dataclass(frozen=True, eq=False)
class WindowLabels(Rows):
    """Where windows come from, and what is done in them."""

    clip: Int[Tensor, " windows"]
    """Index of each window's clip in its set."""
    first: Int[Tensor, " windows"]
    """First frame of each window in its clip."""
    gait: Int[Tensor, " windows"]
    """Gait of each window, an index into GAITS."""
    feet: Int[Tensor, "windows frames 2"]
    """Phases of both feet in each frame, indices into FOOT_PHASES."""


@dataclass(frozen=True, eq=False)
class PartedWindows(Rows):
    """Windows as parts."""

    labels: WindowLabels
    """What is known of them."""
    parts: Float[Tensor, "windows bands frames_and_one joints 3"]
    """Parts, metres (see `cut_parts`)."""

    def channels(self) -> Float[Tensor, "windows frames channels"]:
        """Return what networks see."""
        return join_parts(self.parts.sum(dim=1))


@dataclass(frozen=True, eq=False)
class GatheredEvidence(Rows):
    """One set's held-out windows, and their evidence."""

    labels: WindowLabels
    """What is known of the windows."""
    evidence: PathEvidence
    """Evidence between each window and its partners, their mean."""
    made_feet: Int[Tensor, "windows frames 2"]
    """Phases of the feet of the made window of each pair, indices into FOOT_PHASES."""
    logits: Float[Tensor, " windows"]
    """Logit of each window, positive where it is taken for a made one."""
    exchanged: Float[Tensor, "windows groups"]
    """Logits after an exchange of each group with the nearest window (see `exchange_groups`)."""


def label_windows(positions: Float[Tensor, "_ joints 3"], clip: int, settings: WindowSettings) -> WindowLabels:
    """Label the windows of one clip, in the order in which `cut_windows` cuts them."""
    frames, _, _ = find_window_frames(positions, settings)
    return WindowLabels(
        torch.full((len(frames),), clip),
        frames[:, 1],
        classify_gaits(positions, settings),
        find_foot_phases(positions)[frames[:, 1:]],
    )


def gather_folds(
    folds: Sequence[HeldOutFold],
    made: Sequence[Float[Tensor, "_ joints 3"]],
    mocap: Sequence[Float[Tensor, "_ joints 3"]],
    *,
    windows: WindowSettings,
    settings: EvidenceSettings,
    tick: Callable[[], None] = lambda: None,
) -> tuple[GatheredEvidence, GatheredEvidence]:
    """Gather the evidence of made and of mocap windows, from clips that each fold's network did not see.

    `made` and `mocap` are the world positions of canonical joints of each clip, as `canonical_positions` gives them, in
    the order in which their windows were judged.
    """
    sides: tuple[list[GatheredEvidence], list[GatheredEvidence]] = ([], [])
    for fold in folds:
        pools = [
            _cut_pool(clips, positions, windows, settings)
            for clips, positions in zip(fold.clips, (made, mocap), strict=True)
        ]
        basis = Basis.of(pools[1].channels(), _DIMS)
        points = [basis.project(pool.channels()) for pool in pools]
        for side, gathered in enumerate(sides):
            nearest = find_nearest(points[side], points[1 - side], settings.partners)
            partners = [take_rows(pools[1 - side], rows) for rows in nearest.T]
            gathered.append(_gather(fold.network, pools[side], partners, settings.steps, made=side == 0))
        tick()
    return join_rows(sides[0]), join_rows(sides[1])


def _cut_pool(
    clips: Sequence[int], positions: Sequence[Tensor], windows: WindowSettings, settings: EvidenceSettings
) -> PartedWindows:
    """Cut clips into windows as parts, of which so many are kept at most, evenly spaced."""
    labels = join_rows([label_windows(positions[clip], clip, windows) for clip in clips])
    kept = torch.linspace(0, len(labels) - 1, min(settings.windows, len(labels)), dtype=torch.float64).round().long()
    labels, parts = take_rows(labels, kept), []
    for clip in clips:
        rows = (labels.first[labels.clip == clip] - 1).div(windows.step, rounding_mode="floor")
        parts.append(cut_parts(positions[clip], windows)[rows])
    return PartedWindows(labels, torch.cat(parts))


def _gather(
    network: nn.Module, own: PartedWindows, partners: Sequence[PartedWindows], steps: int, *, made: bool
) -> GatheredEvidence:
    """Gather the evidence of made windows, or of mocap windows, against each of their partners."""
    pairs = [(own.parts, other.parts) if made else (other.parts, own.parts) for other in partners]
    return GatheredEvidence(
        own.labels,
        average_tables([gather_evidence(network, *pair, steps=steps) for pair in pairs]),
        (own if made else partners[0]).labels.feet,
        score(network, own.channels()),
        exchange_groups(network, own.parts, partners[0].parts),
    )
