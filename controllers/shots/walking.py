"""Walks and stands of a shot, span by span: the density's part of it."""

import math
from collections.abc import Callable, Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from controllers.common.character import Character
from controllers.following.follow import FollowSettings, walk_arcs
from controllers.shots.joining import TAIL, Piece, spread_over
from controllers.shots.keys.reaching import ReachTargets
from controllers.shots.request import ShotRequest
from controllers.shots.way import Span, Way, cut_curve, lay_timeline
from mapctl.errors import MapctlError
from mapctl.features import PRIOR_FPS
from mapctl.kinematics.placing import move_to, rotate_about_vertical
from mapctl.motion import Motion
from mapctl.problem.ledger import Ledger
from mapctl.problem.solution import Outcome, WindowRecord
from mapctl.protocols import Density
from mapctl.skeleton import CANONICAL, TOES
from mapctl.terms import KeepApart, KeepClear, Term

_TOES = list(CANONICAL.indices(TOES))
_TRIES = 5  # walks of a span, of which the first that passes is taken, or the best
_MOST_OFF, _MOST_BENT = 0.3, 70.0  # metres from where the hips were to be; m/s^2 of a toe: a circle's is 45


def walk_pieces(
    prior: Density,
    request: ShotRequest,
    way: Way,
    rest: Motion,
    *,
    character: Character,
    settings: FollowSettings,
    generator: torch.Generator,
    progress: Callable[[int, int], None] | None = None,
) -> tuple[list[Piece], list[tuple[Ledger, tuple[WindowRecord, ...]]]]:
    """Stand and walk along a way, span by span; also return ledger and windows of each walk."""
    frames = len(way.speeds)
    reach = ReachTargets.of(request.reaches, frames)
    pieces, walked = [], []
    for span in lay_timeline(way.speeds, slowest=character.data_limits(prior.limits).slowest):
        if span.what == "stand":
            lead = request.lead if span.start == 0 else None
            standing = _stand(rest, way, span) if lead is None else lead.last_pose
            pieces.append(Piece(span, spread_over(standing, 0, frames)))
            continue
        motion, ledger, windows = _walk(
            prior, way, span, request, reach, character=character, settings=settings, generator=generator
        )
        pieces.append(Piece(span, spread_over(motion, span.start, frames)))
        walked.append((ledger, windows))
        if progress is not None:
            progress(span.stop, frames)
    return pieces, walked


def _walk(
    prior: Density,
    way: Way,
    span: Span,
    request: ShotRequest,
    reach: ReachTargets,
    *,
    character: Character,
    settings: FollowSettings,
    generator: torch.Generator,
) -> tuple[Motion, Ledger, tuple[WindowRecord, ...]]:
    """Walk the frames of a span, and some more at its last speed where another span follows."""
    tail = TAIL if span.stop < len(way.speeds) else 0
    frames = span.stop - span.start + tail
    arcs = _extend(way.arcs[span.start : span.stop], tail + settings.window.frames)
    curve = way.curve
    if span.start > 0:
        curve, arcs = cut_curve(curve, float(arcs[0]), float(arcs[-1]) + 1.0), arcs - arcs[0]

    def terms_of(first: int, count: int) -> Sequence[Term]:
        begin = span.start + first
        terms: list[Term] = list(reach.terms(character.skeleton, begin, count))
        if request.obstacles:
            terms.append(KeepClear(request.obstacles))
        if request.others is not None:
            last = request.others.hips.shape[1] - 1
            hips = request.others.hips[:, torch.arange(begin, begin + count).clamp(max=last)]
            terms.append(KeepApart(hips, request.others.distance + 0.05))
        return terms

    start = request.lead.start(prior, character) if request.lead is not None and span.start == 0 else None
    best, least = None, math.inf
    for _ in range(_TRIES):
        motion, done, outcome = walk_arcs(
            prior,
            curve,
            arcs,
            frames,
            character=character,
            settings=settings,
            generator=generator,
            terms_of=terms_of,
            start=start,
        )
        if outcome is Outcome.INTERRUPTED:  # half a shot is none: its other half would stand still
            raise KeyboardInterrupt
        if outcome is not Outcome.DONE:
            raise MapctlError(f"the walk from frame {span.start} on {outcome.value}")
        fault = _judge_walk(motion, curve.ground_point(arcs[:frames]))
        if fault < least:
            best, least = (motion, done.ledger, done.windows), fault
        if fault <= 1:
            break
    assert best is not None
    return best


def _judge_walk(motion: Motion, wanted: Float[Tensor, "frames 2"]) -> float:
    """Return how faulty a walk is, 1 where it just passes: how far the hips come to be from where they were to be at
    that time, and the largest acceleration of a toe. A walk now and then gets stuck in a corner, or lunges out of it;
    another one that begins otherwise does not."""
    off = float((motion.root_position[:, ::2] - wanted.to(motion.root_position)).norm(dim=-1).max())
    toes = motion.joint_positions()[:, _TOES]
    bent = float(torch.diff(toes, n=2, dim=0).norm(dim=-1).max()) * PRIOR_FPS**2 if len(toes) > 2 else 0.0
    return max(off / _MOST_OFF, bent / _MOST_BENT)


def _extend(arcs: Float[Tensor, " frames"], more: int) -> Float[Tensor, " ahead"]:
    """Go on at the last speed."""
    return torch.cat([arcs, arcs[-1] + (arcs[-1] - arcs[-2]) * torch.arange(1, more + 1)])


def _stand(rest: Motion, way: Way, span: Span) -> Motion:
    """Stand where the way is during a span, facing along it."""
    arc = way.arcs[span.start]
    return move_to(rotate_about_vertical(rest, way.curve.heading(arc)), way.curve.ground_point(arc))
