"""Benchmark of transitions by LaFAN1's protocol (Harvey et al. 2020): gaps in unseen clips after ten frames, after one
bare pose, or with the whole clip around, by kind of clip, length and method.
"""

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import torch
from jaxtyping import Float
from torch import Tensor

from controllers.benchmarks.shared.tables import Row
from controllers.benchmarks.transitions.appearance import measure_appearance
from controllers.benchmarks.transitions.methods import Energy, Filled, Method, Sampler
from controllers.benchmarks.transitions.twins import measure_twins
from controllers.benchmarks.transitions.windows import PAST, Gap, find_gaps, put_in
from mapctl.metrics import transitions
from mapctl.metrics.realism import RealismSettings, WindowSettings, canonical_positions, cut_windows, train_judges
from mapctl.motion import Motion

LENGTHS = (5, 15, 30, 45)
"""Frames of the gaps, as in the tables of LaFAN1."""
DRAWS = 8
"""Answers drawn of each gap."""
ALL_KINDS = "mean of kinds"
"""Kind of the rows that average those of all kinds."""
_TOLD = ("kind", "frames", "windows", "method")
_WORST = ("missed_cm", "step_cm", "acceleration_m_s2", "apart_most_cm")
_REALISM_LENGTH = 30
_REALISM = RealismSettings(windows=WindowSettings(frames=30))


def benchmark_transitions(
    kinds: Mapping[str, Sequence[Motion]],
    methods: Mapping[str, Method],
    *,
    past: int | None,
    std: Float[Tensor, "joints 3"],
    baseline: str,
    samplers: Mapping[str, Sampler] | None = None,
    energy: Energy | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> list[Row]:
    """Measure every method by kind of clip and length of gap; clips are canonical, of canonical bones, at PRIOR_FPS.

    `past` frames are known before a gap, and one after; None shows the whole clip. L2P divides by `std`. Shares are of
    the method `baseline`. Also: planted toes, jitter and the worst frames of gaps with ten true frames on either side,
    beside mocap's; how far the two sides of a stitched gap were apart; how often a small network tells gaps of 30
    frames from mocap; milliseconds for each filled frame.

    Of `samplers` there are two rows: the first of DRAWS answers, with the distance of all of them from each other
    (beside mocap's, that of its twins: `measure_twins`), and the one of them that is nearest to the truth; with
    `energy` a third, the one that has the least of it.
    """
    samplers, rows = samplers or {}, []
    names = [*methods, *(name for sampler in samplers for name in _name_draws(sampler, energy))]
    total = len(LENGTHS) * len(kinds) * (len(methods) + len(samplers))
    done = 0
    for length in LENGTHS:
        cut: dict[str, list[Tensor]] = {name: [] for name in ("mocap", *names)}  # of each clip
        found = []
        for kind, clips in kinds.items():
            by_clip = [found_in for clip in clips if (found_in := find_gaps(clip, length, past))]
            gaps = [gap for each in by_clip for gap in each]
            if not gaps:
                continue
            shared = {"kind": kind, "frames": length, "windows": len(gaps)}
            truth = [gap.around for gap in gaps]
            twins = measure_twins(clips, [gap.inner for gap in gaps]) if samplers else {}
            made = [_Made("mocap", truth, {**measure_appearance(truth), **twins})]
            for task in (
                *(partial(_run_method, name, method) for name, method in methods.items()),
                *(partial(_run_sampler, name, sampler, energy) for name, sampler in samplers.items()),
            ):
                made += task(gaps, std)
                done += 1
                if progress is not None:
                    progress(done, total)
            for each in made:
                found.append({**shared, "method": each.name, **each.row})
                cut[each.name] += _cut(each.motions, by_clip) if length == _REALISM_LENGTH else []
        rows += found + _average_kinds(found, ["mocap", *names], baseline, length)
        if length == _REALISM_LENGTH:
            _add_realism(rows, cut)
    return rows


@dataclass(frozen=True, eq=False)
class _Made:
    """What a method made of all gaps of a kind and length, and its row."""

    name: str
    motions: Sequence[Motion]
    row: Row


def _run_method(name: str, method: Method, gaps: Sequence[Gap], std: Tensor) -> list[_Made]:
    began = time.process_time()
    filled = [method(gap.part, gap.start, gap.stop) for gap in gaps]
    cost = _count_ms(began, gaps)
    motions = [put_in(each, gap) for each, gap in zip(filled, gaps, strict=True)]
    return [
        _Made(name, motions, {**_compare(motions, gaps, std), **measure_appearance(motions), **cost, **_tell(filled)})
    ]


def _run_sampler(name: str, sampler: Sampler, energy: Energy | None, gaps: Sequence[Gap], std: Tensor) -> list[_Made]:
    began = time.process_time()
    draws = [sampler(gap.part, gap.start, gap.stop, DRAWS) for gap in gaps]
    cost = _count_ms(began, gaps)
    firsts = [each[0] for each in draws]
    motions = [[put_in(one, gap) for one in each] for each, gap in zip(draws, gaps, strict=True)]
    spreads = [_measure_spread(each, gap) for each, gap in zip(motions, gaps, strict=True)]
    spread = {key: sum(each[key] for each in spreads) / len(spreads) for key in spreads[0]}
    one = [each[0] for each in motions]
    best = [_pick_nearest(each, gap, std) for each, gap in zip(motions, gaps, strict=True)]
    first, nearest, *likeliest = _name_draws(name, energy)
    made = [
        _Made(first, one, {**_compare(one, gaps, std), **measure_appearance(one), **cost, **_tell(firsts), **spread}),
        _Made(nearest, best, {**_compare(best, gaps, std), **measure_appearance(best)}),
    ]
    if energy is not None:
        least = [min(each, key=energy) for each in motions]
        made.append(_Made(likeliest[0], least, {**_compare(least, gaps, std), **measure_appearance(least)}))
    return made


def _name_draws(sampler: str, energy: Energy | None) -> list[str]:
    names = [f"{sampler}, one draw", f"{sampler}, best of {DRAWS} by truth"]
    return names if energy is None else [*names, f"{sampler}, best of {DRAWS} by energy"]


def _count_ms(began: float, gaps: Sequence[Gap]) -> Row:
    return {"frame_ms": 1000 * (time.process_time() - began) / sum(gap.stop - gap.start for gap in gaps)}


def _tell(filled: Sequence[Filled]) -> Row:
    """Tell how far sides were apart, where something was stitched."""
    apart = [100 * each.apart for each in filled if each.apart is not None]
    return {"apart_cm": sum(apart) / len(apart), "apart_most_cm": max(apart)} if apart else {}


def _measure_spread(draws: Sequence[Motion], gap: Gap) -> Row:
    """Measure how far draws are from each other: mean distance of joints, and Ren et al.'s APD."""
    positions = torch.stack([each.joint_positions()[gap.filled] for each in draws])
    mean, flat = transitions.compute_pairwise_distances(positions)
    return {"spread_cm": 100 * mean, "apd_cm": 100 * flat}


def _pick_nearest(draws: Sequence[Motion], gap: Gap, std: Tensor) -> Motion:
    """Pick the draw with the least L2P: with the truth at hand, which nobody has."""
    truth = gap.around.joint_positions()[None, gap.filled]
    errors = [transitions.compute_l2p(each.joint_positions()[None, gap.filled], truth, std) for each in draws]
    return draws[min(range(len(draws)), key=errors.__getitem__)]


def _compare(made: Sequence[Motion], gaps: Sequence[Gap], std: Tensor) -> Row:
    """Measure errors of one length."""
    part, sides = gaps[0].filled, []
    for motions in (made, [gap.around for gap in gaps]):
        parts = [motion.slice(part.start, part.stop) for motion in motions]
        sides.append(
            (
                torch.stack([part.joint_positions() for part in parts]),
                torch.stack([part.joint_rotations() for part in parts]),
            )
        )
    (positions, quats), (true_positions, true_quats) = sides
    ade, last = transitions.compute_joint_distances(positions, true_positions)
    return {
        "ade_cm": 100 * ade,
        "last_cm": 100 * last,
        "l2p": transitions.compute_l2p(positions, true_positions, std),
        "l2q": transitions.compute_l2q(quats, true_quats),
        "npss": transitions.compute_npss(quats, true_quats),
    }


def average_measures(rows: Sequence[Row]) -> Row:
    """Average rows of measures over those that have them; of the worst frames the worst stays."""
    # Kinds without twins, or without a gap that was stitched, have fewer columns.
    columns = {name: [row[name] for row in rows if name in row] for row in rows for name in row}
    return {name: max(each) if name in _WORST else sum(each) / len(each) for name, each in columns.items()}


def _drop_told(row: Row) -> Row:
    """Drop what tells rows apart, and is no measure."""
    return {name: value for name, value in row.items() if name not in _TOLD}


def _average_kinds(found: Sequence[Row], methods: Sequence[str], baseline: str, length: int) -> list[Row]:
    """Average over kinds, and add shares of the baseline's errors to all rows."""
    errors = ("ade_cm", "l2p", "l2q", "npss")
    by_kind = {(row["kind"], row["method"]): row for row in found}
    rows = []
    for method in methods:
        own = [row for row in found if row["method"] == method]
        if not own:
            continue
        mean: Row = {"kind": ALL_KINDS, "frames": length, "windows": sum(row["windows"] for row in own)}
        mean |= {"method": method} | average_measures([_drop_told(row) for row in own])
        rows.append(mean)
    by_kind |= {(row["kind"], row["method"]): row for row in rows}
    for row in by_kind.values():
        reference = by_kind.get((row["kind"], baseline))
        if reference is not None and "ade_cm" in row:
            row |= {f"{name.removesuffix('_cm')}_share": row[name] / max(reference[name], 1e-12) for name in errors}
    return rows


def _cut(motions: Sequence[Motion], by_clip: Sequence[Sequence[Gap]]) -> list[Tensor]:
    """Cut gaps out, each with the frame before it, for the network that tells them from mocap: those of a clip
    together."""
    parts = [motion.slice(PAST - 1, PAST + _REALISM_LENGTH) for motion in motions]
    windows = iter([cut_windows(canonical_positions(part), _REALISM.windows) for part in parts])
    return [torch.cat([next(windows) for _ in gaps]) for gaps in by_clip]


def _add_realism(rows: list[Row], made: Mapping[str, Sequence[Tensor]]) -> None:
    """Tell made gaps from mocap's: no network judges gaps of a clip of which it has seen any, made or captured. Both
    are of the same windows, and one that knows the captured gap tells the made one by what it shares with it."""
    mocap = made["mocap"]
    if len(mocap) < _REALISM.min_clips:
        return
    for row in rows:
        if row["kind"] == ALL_KINDS and row["frames"] == _REALISM_LENGTH and row["method"] != "mocap":
            seeded = torch.Generator().manual_seed(0)
            judges = train_judges(made[row["method"]], mocap, generator=seeded, settings=_REALISM, paired=True)
            found = judges.summarise()
            row |= {"told_apart": found.accuracy, "mocap_told_apart": found.floor_accuracy, "frechet": found.frechet}
            row |= {"mocap_frechet": found.floor_frechet}
