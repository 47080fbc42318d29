"""What gives made motion away: shares of joints, bands, inputs and moments in the verdict, and accuracy by gait."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from mapctl.metrics.realism.classifier import ClassifierSettings, HeldOutFold, average_verdicts, balanced_accuracy
from mapctl.metrics.realism.evidence.alone import REGIONS, measure_alone
from mapctl.metrics.realism.evidence.gathering import EvidenceSettings, GatheredEvidence, gather_folds
from mapctl.metrics.realism.evidence.kinds import BODY_PHASES, FOOT_PHASES, GAITS, classify_gaits, join_foot_phases
from mapctl.metrics.realism.evidence.moments import Moment, is_leg, list_moments
from mapctl.metrics.realism.evidence.parts import BANDS, JOINTS
from mapctl.metrics.realism.evidence.paths import INPUTS
from mapctl.metrics.realism.evidence.rows import Rows, join_rows, take_rows
from mapctl.metrics.realism.evidence.shares import Share, Side, compute_shares
from mapctl.metrics.realism.windows import WindowSettings


@dataclass(frozen=True, eq=False)
class JudgedWindows(Rows):
    """One set's windows of all folds."""

    clip: Int[Tensor, " windows"]
    """Index of the clip in its set."""
    gait: Int[Tensor, " windows"]
    """Gait, an index into GAITS."""
    correct: Float[Tensor, " windows"]
    """1 where the network, which did not see the clip, names the window's own set, else 0."""


@dataclass(frozen=True)
class GaitAccuracy:
    """How well windows of one gait are told apart."""

    gait: str
    """Gait, one of GAITS."""
    made_windows: int
    """Number of made windows."""
    mocap_windows: int
    """Number of mocap windows."""
    accuracy: float
    """Balanced held-out accuracy; NaN where either set has none."""
    floor: float
    """The same for the halves of the mocap."""
    made_told: float
    """Share of the made windows that are told to be made."""
    joint: str | None
    """Joint with the most evidence in this gait that is more than chance; None where there is none."""
    band: str | None
    """Band with the most evidence in this gait that is more than chance; None where there is none."""


@dataclass(frozen=True)
class Explanation:
    """What networks go by that tell made motion from mocap."""

    steps: int
    """Training steps of each network."""
    accuracy: float
    """Balanced held-out accuracy, made against mocap."""
    accuracy_low: float
    """Lower end of its interval of 95 % over clips."""
    accuracy_high: float
    """Upper end of that interval."""
    floor: float
    """The same accuracy for the halves of the mocap."""
    told_apart: bool
    """Whether that interval lies above both the floor and one half; if not, shares are of chance and name no cause."""
    joints: list[Share]
    """Shares by joint, each from the joint above it."""
    bands: list[Share]
    """Shares by band of frequency."""
    inputs: list[Share]
    """Shares by kind of input."""
    cells: list[Share]
    """Shares by joint and band."""
    phases: list[Share]
    """Shares by phase of the body's step, with the share of frames that are in it."""
    feet: list[Share]
    """Shares of lower legs, feet and toes by the phase of their own foot."""
    regions: dict[str, float]
    """Accuracy of networks that are given one of REGIONS alone; empty where it was not asked for."""
    gaits: list[GaitAccuracy]
    """Accuracy by gait, of gaits that either set has."""
    moments: list[Moment]
    """Windows most surely told to be made."""


def explain(
    folds: Sequence[HeldOutFold],
    floor_folds: Sequence[HeldOutFold],
    made: Sequence[Float[Tensor, "_ joints 3"]],
    mocap: Sequence[Float[Tensor, "_ joints 3"]],
    halves: tuple[Sequence[int], Sequence[int]],
    *,
    classifier: ClassifierSettings,
    windows: WindowSettings,
    settings: EvidenceSettings,
    generator: torch.Generator,
    tick: Callable[[], None] = lambda: None,
) -> Explanation:
    """Explain the verdicts of `folds`, made against mocap, and `floor_folds`, one of the `halves` of mocap's clips
    against the other.

    Shares are of the evidence between windows and their nearest of the other set (see `paths`), and the accuracy after
    an exchange is model reliance by group (Fisher et al. 2019, section 3; for single inputs of a forest Breiman 2001,
    section 10): made and mocap windows exchange it with that partner instead of any other window, so that what is
    exchanged fits. All is of windows that the network did not see.
    """
    alone = _measure_alone(made, mocap, classifier, windows, settings, generator, tick)
    sides = gather_folds(folds, made, mocap, windows=windows, settings=settings, tick=tick)
    made_gaits, mocap_gaits = ([classify_gaits(clip, windows) for clip in clips] for clips in (made, mocap))
    judged = _judge(folds, [made_gaits, mocap_gaits])
    floor = _judge(floor_folds, [[mocap_gaits[clip] for clip in half] for half in halves])
    low, high = torch.quantile(_draw_accuracies(judged, generator), torch.tensor([0.025, 0.975]).double()).tolist()
    floor_accuracy = average_verdicts(floor_folds).accuracy
    return Explanation(
        classifier.steps,
        average_verdicts(folds).accuracy,
        low,
        high,
        floor_accuracy,
        low > max(floor_accuracy, 0.5),
        **_compute_tables(sides, alone, generator),
        regions={name: alone[name] for name in REGIONS if name in alone},
        gaits=_compare_gaits(judged, floor, sides, generator),
        moments=list_moments(sides[0], settings.moments),
    )


def _judge(
    folds: Sequence[HeldOutFold], gaits: Sequence[Sequence[Int[Tensor, " windows"]]]
) -> tuple[JudgedWindows, JudgedWindows]:
    """Put the networks' verdicts of both sets beside the gait of each clip's windows."""
    sides: tuple[list[JudgedWindows], list[JudgedWindows]] = ([], [])
    for fold in folds:
        for side, found in enumerate(sides):
            clips, logits = fold.clips[side], fold.logits[side]
            clip = torch.cat([torch.full((len(gaits[side][number]),), number) for number in clips])
            own = torch.cat([gaits[side][number] for number in clips])
            correct = (logits > 0) if side == 0 else (logits <= 0)
            found.append(JudgedWindows(clip, own, correct.double()))
    return join_rows(sides[0]), join_rows(sides[1])


def _draw_accuracies(sides: Sequence[JudgedWindows], generator: torch.Generator) -> Float[Tensor, " draws"]:
    """Draw both sets' clips anew, many times, and compute the balanced accuracy of each draw."""
    by_clip = [Side.of(side.correct[:, None], side.clip) for side in sides]
    return torch.stack([side.average(side.draw(generator))[:, 0] for side in by_clip]).mean(dim=0)


def _measure_alone(
    made: Sequence[Tensor],
    mocap: Sequence[Tensor],
    classifier: ClassifierSettings,
    windows: WindowSettings,
    settings: EvidenceSettings,
    generator: torch.Generator,
    tick: Callable[[], None],
) -> dict[str, float]:
    """Measure accuracies by one group alone, where they are asked for."""
    if not settings.alone_steps:
        return {}
    fewer, seed = replace(classifier, steps=settings.alone_steps), int(torch.randint(2**62, (1,), generator=generator))
    return measure_alone(made, mocap, windows=windows, classifier=fewer, seed=seed, tick=tick)


def _compute_tables(
    sides: Sequence[GatheredEvidence], alone: Mapping[str, float], generator: torch.Generator
) -> dict[str, list[Share]]:
    exchanged = [balanced_accuracy(*pair) for pair in zip(*(side.exchanged.T for side in sides), strict=True)]
    bands, joints = exchanged[: len(BANDS)], exchanged[len(BANDS) : -len(INPUTS)]
    cells = [f"{joint}, {band}" for band in BANDS for joint in JOINTS]
    phases = [
        _sum_by(side.evidence.frames.sum(dim=-1), join_foot_phases(side.made_feet), len(BODY_PHASES)) for side in sides
    ]
    feet = [_sum_by_foot(side) for side in sides]

    def share(names: Sequence[str], evidence: Sequence[Tensor], **more: Sequence[float]) -> list[Share]:
        groups = [Side.of(each, side.labels.clip) for each, side in zip(evidence, sides, strict=True)]
        return [replace(one, alone=alone.get(one.name)) for one in compute_shares(names, groups, generator, **more)]

    return {
        "joints": share(JOINTS, [side.evidence.cells.sum(dim=1) for side in sides], exchanged=joints),
        "bands": share(BANDS, [side.evidence.cells.sum(dim=2) for side in sides], exchanged=bands),
        "inputs": share(INPUTS, [side.evidence.inputs for side in sides], exchanged=exchanged[-len(INPUTS) :]),
        "cells": share(cells, [side.evidence.cells.flatten(1) for side in sides]),
        "phases": share(BODY_PHASES, [sums for sums, _ in phases], frames=_average_shares([f for _, f in phases])),
        "feet": share(FOOT_PHASES, [sums for sums, _ in feet], frames=_average_shares([f for _, f in feet])),
    }


def _sum_by(
    evidence: Float[Tensor, "windows frames"], kind: Int[Tensor, "windows frames"], kinds: int
) -> tuple[Float[Tensor, "windows kinds"], Float[Tensor, " kinds"]]:
    """Sum evidence over the frames of each kind, and count the share of all frames that are of it."""
    sums = torch.zeros(len(kind), kinds, dtype=evidence.dtype).scatter_add_(1, kind, evidence)
    return sums, torch.bincount(kind.flatten(), minlength=kinds).double() / kind.numel()


def _sum_by_foot(side: GatheredEvidence) -> tuple[Float[Tensor, "windows kinds"], Float[Tensor, " kinds"]]:
    """Sum the evidence of each leg's joints over the phases of its own foot."""
    found = []
    for foot, name in enumerate(("left", "right")):
        own = [joint for joint in range(len(JOINTS)) if is_leg(joint) and JOINTS[joint].startswith(name)]
        found.append(_sum_by(side.evidence.frames[..., own].sum(dim=-1), side.made_feet[..., foot], len(FOOT_PHASES)))
    (left, left_frames), (right, right_frames) = found
    return left + right, (left_frames + right_frames) / 2


def _average_shares(shares: Sequence[Float[Tensor, " kinds"]]) -> list[float]:
    return torch.stack(list(shares)).mean(dim=0).tolist()


def _compare_gaits(
    judged: Sequence[JudgedWindows],
    floor: Sequence[JudgedWindows],
    sides: Sequence[GatheredEvidence],
    generator: torch.Generator,
) -> list[GaitAccuracy]:
    rows = []
    for number, gait in enumerate(GAITS):
        own, halves = ([side.correct[side.gait == number] for side in pair] for pair in (judged, floor))
        if not any(len(each) for each in own):
            continue
        part = [take_rows(side, side.labels.gait == number) for side in sides]
        rows.append(
            GaitAccuracy(
                gait,
                len(own[0]),
                len(own[1]),
                _average_sides(own),
                _average_sides(halves),
                float(own[0].mean()),
                _name_first(JOINTS, part, [side.evidence.cells.sum(dim=1) for side in part], generator),
                _name_first(BANDS, part, [side.evidence.cells.sum(dim=2) for side in part], generator),
            )
        )
    return rows


def _average_sides(correct: Sequence[Float[Tensor, " windows"]]) -> float:
    """Average over both sets; NaN where either is empty."""
    return sum(float(each.mean()) for each in correct) / len(correct)


def _name_first(
    names: Sequence[str], sides: Sequence[GatheredEvidence], evidence: Sequence[Tensor], generator: torch.Generator
) -> str | None:
    """Name the group with the largest share that is more than chance."""
    if not all(len(side) for side in sides):
        return None
    groups = [Side.of(each, side.labels.clip) for each, side in zip(evidence, sides, strict=True)]
    if any(len(group.counts) < 2 for group in groups):  # a clip alone says nothing of others
        return None
    return next((share.name for share in compute_shares(names, groups, generator) if share.named), None)
