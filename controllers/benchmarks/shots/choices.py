"""Ablation of shots' choices: when first steps begin and last ones end, by grid, samples, swarm, or not at all."""

import math
import time
from collections.abc import Callable

import torch

from controllers.benchmarks.shared.tables import Row, average_rows
from controllers.benchmarks.shots.fulfilment import draw_shot
from controllers.common.character import Character
from controllers.following.follow import FollowSettings
from controllers.inbetweening.pipeline import fill
from controllers.shots.joining import JoinSettings, Piece, join_pieces
from controllers.shots.keys.approaching import check_reaches
from controllers.shots.planning.way import plan_way
from controllers.shots.rest_pose import build_rest_pose
from controllers.shots.transitions import judge
from controllers.shots.walking import walk_pieces
from mapctl.errors import RequestError
from mapctl.features import PRIOR_FPS
from mapctl.inbetweening.missing import MissingMask
from mapctl.metrics import feet, worst_frame
from mapctl.numerics.intervals import true_intervals
from mapctl.protocols import Density, Inbetweener
from mapctl.skeleton import CANONICAL, TOE_REST_HEIGHT, TOES

_TOES = list(CANONICAL.indices(TOES))
_ENDS = list(CANONICAL.indices(("leftHand", "rightHand", *TOES)))
VARIANTS: dict[str, JoinSettings] = {
    "the middle": JoinSettings("middle"),
    "grid": JoinSettings("grid"),
    **{
        f"{search}, {count}": JoinSettings(search, evaluations=count)
        for count in (15, 30)
        for search in ("samples", "swarm")
    },
}
"""Ways to choose, by name."""


def benchmark_shot_choices(
    prior: Density,
    inbetweener: Inbetweener,
    *,
    count: int,
    seed: int = 0,
    progress: Callable[[int, int], None] | None = None,
) -> list[Row]:
    """Join the walks and standings of random shots by every variant: what a viewer would mind in the finished
    transitions, and the time that it takes; walks are the same for all. Shots without a transition are drawn again."""
    generator, rows = torch.Generator().manual_seed(seed), {name: [] for name in VARIANTS}
    number = 0
    while number < count:
        pieces = _walk_shot(prior, generator, number)
        if len(pieces) < 2:
            continue
        for name, settings in VARIANTS.items():
            rows[name].append(_measure_join(pieces, inbetweener, settings))
        number += 1
        if progress is not None:
            progress(number, count)
    best = [min(each) for each in zip(*([row["cost_m_s"] for row in found] for found in rows.values()), strict=True)]
    return [
        {
            "choice": name,
            "shots": len(found),
            **average_rows(found),
            "worst_acceleration_m_s2": max(row["acceleration_m_s2"] for row in found),
            "best_pct": 100
            * sum(row["cost_m_s"] <= low + 1e-9 for row, low in zip(found, best, strict=True))
            / len(found),
        }
        for name, found in rows.items()
    ]


def _walk_shot(prior: Density, generator: torch.Generator, number: int) -> list[Piece]:
    """Walk a random shot; no pieces of one that no body can do."""
    request, _ = draw_shot(generator)
    way, rest = plan_way(request), build_rest_pose(prior, CANONICAL, TOE_REST_HEIGHT)
    try:
        check_reaches(request.reaches, way, rest)
    except RequestError:
        return []
    stands = bool((way.speeds < 0.05).any())
    if not stands:
        return []
    seeded = torch.Generator().manual_seed(number)
    return walk_pieces(prior, request, way, rest, character=Character(), settings=FollowSettings(), generator=seeded)[0]


def _measure_join(pieces: list[Piece], inbetweener: Inbetweener, settings: JoinSettings) -> dict[str, float]:
    """Measure the finished transitions: what a viewer would mind, the largest acceleration of a hand or a toe, planted
    toes, and the seconds that each search took."""
    began = time.perf_counter()
    joined, missing = join_pieces(pieces, inbetweener, settings)
    spent = time.perf_counter() - began
    done = fill(joined, MissingMask.of_frames(missing, joined.num_joints), inbetweener)
    runs = [(start, stop) for _, start, stop in true_intervals(missing[:, None])]
    positions = done.motion.joint_positions()
    peaks, planted = [], []
    for start, stop in runs:
        shown = slice(start - 2, stop + 2)
        peaks.append(worst_frame.measure_peaks(positions[shown, _ENDS], positions[shown, 0], PRIOR_FPS).acceleration)
        toes = feet.ToeMeasurements.of(positions[shown][:, _TOES], PRIOR_FPS)
        if bool(toes.planted[1:].any()):
            planted.append(100 * float(toes.speed[toes.planted[1:]].mean()))
    return {
        "cost_m_s": sum(judge(done.motion, done.contacts, run) for run in runs) / len(runs),
        "acceleration_m_s2": max(peaks),
        "planted_cm_s": sum(planted) / len(planted) if planted else math.nan,
        "search_s": spent / len(runs),
    }
