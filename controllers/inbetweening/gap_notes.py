"""What a user should know of every gap: who proposed the motion in it, how far such answers are from the truth, and
where nobody knows what happens.
"""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from controllers.inbetweening.error_estimates import (
    INFILLER,
    TRAINED_GAP_FRAMES,
    ErrorEstimate,
    estimate_error,
    is_travelling,
)
from controllers.inbetweening.proposers.auto import STANDING_STILL
from mapctl import rotations
from mapctl.features import PRIOR_FPS
from mapctl.inbetweening import GapQuery
from mapctl.inbetweening.query import GapSource
from mapctl.kinematics import heading
from mapctl.motion import Motion

_MIN_CONTEXT_FRAMES = 8  # known frames on both sides that tell how somebody moves
_MORPH_RATIO, _MIN_MORPH_FRAMES = 1.3, 45
"""A motion that goes hardly further than straight from pose to pose, for so long, is no motion that somebody made."""
_STILL_SPEED = 0.12  # m/s of the joints of somebody who hardly moves: there is nothing to miss


def compose_gap_notes(query: GapQuery, made: Motion, sources: Sequence[GapSource], *, fps: float) -> tuple[str, ...]:
    """Compose a line for each gap, in frames of the motion at `fps`; those with nothing of their own to say share one
    by proposer.
    """
    lines: list[str] = []
    plain: dict[str, list[GapSource]] = {}
    for source in sources:
        words = _describe_gap(query, made, source)
        if not words and source.by == INFILLER:
            plain.setdefault(source.by, []).append(source)
        else:
            lines.append(_join_words([source], query, words, fps))
    return (*lines, *(_join_words(each, query, [], fps) for each in plain.values()))


def _join_words(sources: Sequence[GapSource], query: GapQuery, words: Sequence[str], fps: float) -> str:
    """Join where, who, how sure (of the least sure gap), and what else there is to say."""
    where = ", ".join(_format_frames(query, source, fps) for source in sources)
    found = [estimate for source in sources if (estimate := _estimate_gap_error(query, source)) is not None]
    sure = [max(found, key=lambda one: one.percentile_90_cm).text] if found else []
    return f"frames {where}: {', '.join([sources[0].by, *sure, *words])}"


def _format_frames(query: GapQuery, source: GapSource, fps: float) -> str:
    """Format a gap in frames of the motion's own rate."""
    start, stop = (
        float(query.seconds[frame]) for frame in (source.start - 1, min(source.stop, len(query.seconds) - 1))
    )
    return f"{round(start * fps) + 1}:{round(stop * fps)}"


def _estimate_gap_error(query: GapQuery, source: GapSource) -> ErrorEstimate | None:
    known = ~query.missing.frames
    before = known[max(0, source.start - _MIN_CONTEXT_FRAMES) : source.start]
    after = known[source.stop : source.stop + _MIN_CONTEXT_FRAMES]
    beside = min(int(before.sum()), int(after.sum())) >= _MIN_CONTEXT_FRAMES
    going = is_travelling(query.motion, max(0, source.start - 1), min(source.stop, len(known) - 1))
    return estimate_error(source.by, source.stop - source.start, going=going, beside=beside)


def _describe_gap(query: GapQuery, made: Motion, source: GapSource) -> list[str]:
    """List what there is to say of one gap beyond who proposed it and how sure that is."""
    words, seconds = [source.reason] if source.reason else [], (source.stop - source.start) / PRIOR_FPS
    if source.stop - source.start > TRAINED_GAP_FRAMES and source.by == INFILLER:
        words.append(f"and {seconds:.1f} s are longer than the {TRAINED_GAP_FRAMES / PRIOR_FPS:.0f} s that it knows")
    if _is_morph(query, made, source):
        words.append("a still morph: it goes hardly further than straight from one pose to the other; tell more keys")
    return words


def _is_morph(query: GapQuery, made: Motion, source: GapSource) -> bool:
    """Return whether nothing happens but one pose becoming the other, for long, where people move."""
    if source.stop - source.start < _MIN_MORPH_FRAMES or source.by == STANDING_STILL:
        return False
    part = slice(max(0, source.start - 1), source.stop + 1)
    way, straight = (
        _compute_path_length(each.joint_positions()[part], heading(each.local_quat_xyzw[part, 0]))
        for each in (made, query.motion)
    )
    going = is_travelling(query.motion, max(0, source.start - 1), min(source.stop, len(query.missing.root) - 1))
    pace, least = (each * PRIOR_FPS / (source.stop - source.start) for each in (way, straight))
    quiet = least < _STILL_SPEED and _is_still_beside(query, source)
    return pace < max(_STILL_SPEED, _MORPH_RATIO * least) and (going or not quiet)


def _is_still_beside(query: GapQuery, source: GapSource) -> bool:
    """Return whether known frames beside a gap, if there are any, hardly move."""
    places = query.motion.joint_positions()
    for one, other in ((source.start - 2, source.start - 1), (source.stop, source.stop + 1)):
        if one < 0 or other >= len(places) or bool(query.missing.root[[one, other]].any()):
            continue
        if float((places[other] - places[one]).norm(dim=-1).mean()) * PRIOR_FPS > _STILL_SPEED:
            return False
    return True


def _compute_path_length(places: Float[Tensor, "frames joints 3"], facing: Float[Tensor, " frames"]) -> float:
    """Compute how far joints move seen from the hips, mean over joints, metres."""
    turn = rotations.about_y(-facing)[:, None].expand(-1, places.shape[1], 4)
    own = rotations.rotate(turn, places - places[:, :1])
    return float(torch.diff(own, dim=0).norm(dim=-1).sum(dim=0).mean())
