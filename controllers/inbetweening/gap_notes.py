"""Notes on gaps: who proposed the motion in each, how far such proposals are from the truth, and where nothing but an
interpolation is proposed.
"""

from collections.abc import Sequence

from controllers.inbetweening.error_estimates import ErrorEstimate, estimate_error, is_travelling
from controllers.inbetweening.proposers.auto import STANDING_STILL
from mapctl.features import PRIOR_FPS
from mapctl.inbetweening import GapQuery, Proposal
from mapctl.inbetweening.query import GapSource
from mapctl.metrics.liveliness import measure_path_length
from mapctl.motion import Motion

_INFILLER, _INFILLER_FRAMES = "infiller", 75
"""Name of the source whose longest gaps in training were of so many frames: their mean length and a deviation."""
_MIN_CONTEXT_FRAMES = 8  # known frames on both sides that show how the body moves
_MORPH_RATIO, _MIN_MORPH_FRAMES = 1.3, 45
"""Largest ratio of a morph's path to the straight one, and fewest frames: an interpolation instead of a motion."""
_STILL_SPEED = 0.12  # m/s of the joints below which a body is still: there is no motion to miss


def compose_gap_notes(query: GapQuery, made: Motion, answer: Proposal, *, fps: float) -> tuple[str, ...]:
    """Compose a line for each gap of a proposal, in frames of the motion at `fps`; gaps without remarks share one by
    proposer.
    """
    sources = answer.attribute(query)
    lines: list[str] = []
    plain: dict[str, list[GapSource]] = {}
    for source in sources:
        remarks = _describe_gap(query, made, source)
        if not remarks and source.by == answer.source:
            plain.setdefault(source.by, []).append(source)
        else:
            lines.append(_join_remarks([source], query, answer, remarks, fps))
    return (*lines, *(_join_remarks(each, query, answer, [], fps) for each in plain.values()))


def _join_remarks(
    sources: Sequence[GapSource], query: GapQuery, answer: Proposal, remarks: Sequence[str], fps: float
) -> str:
    """Join the frames, the proposer, the error estimate (of the gap with the largest), and further remarks."""
    where = ", ".join(_format_frames(query, source, fps) for source in sources)
    found = [estimate for source in sources if (estimate := _estimate_gap_error(query, answer, source))]
    sure = [max(found, key=lambda one: one.percentile_90_cm).text] if found else []
    return f"frames {where}: {', '.join([sources[0].by, *sure, *remarks])}"


def _format_frames(query: GapQuery, source: GapSource, fps: float) -> str:
    """Format a gap in frames of the motion's own rate."""
    first = 0 if source.start == 0 else round(float(query.seconds[source.start - 1]) * fps) + 1
    last = len(query.seconds) - 1
    stop = round(float(query.seconds[min(source.stop, last)]) * fps)
    return f"{first}:{stop + (source.stop > last)}"


def _estimate_gap_error(query: GapQuery, answer: Proposal, source: GapSource) -> ErrorEstimate | None:
    if answer.spread is not None and source.by == answer.source:
        median, percentile_90 = (100 * answer.spread[source.start : source.stop]).mean(dim=(0, 1)).tolist()
        return ErrorEstimate(median, percentile_90, None)
    known = ~query.missing.frames
    before = known[max(0, source.start - _MIN_CONTEXT_FRAMES) : source.start]
    after = known[source.stop : source.stop + _MIN_CONTEXT_FRAMES]
    in_context = min(int(before.sum()), int(after.sum())) >= _MIN_CONTEXT_FRAMES
    travelling = is_travelling(query.motion, max(0, source.start - 1), min(source.stop, len(known) - 1))
    return estimate_error(source.by, source.stop - source.start, travelling=travelling, in_context=in_context)


def _describe_gap(query: GapQuery, made: Motion, source: GapSource) -> list[str]:
    """List remarks on one gap beyond its proposer and error estimate."""
    remarks, seconds = [*filter(None, (source.reason, source.remark))], (source.stop - source.start) / PRIOR_FPS
    if source.stop - source.start > _INFILLER_FRAMES and source.by == _INFILLER:
        remarks.append(f"and {seconds:.1f} s are longer than the {_INFILLER_FRAMES / PRIOR_FPS:.0f} s that it knows")
    if _is_morph(query, made, source):
        remarks.append("a still morph: it goes hardly further than straight from one pose to the other; give more keys")
    return remarks


def _is_morph(query: GapQuery, made: Motion, source: GapSource) -> bool:
    """Return whether a long gap is filled by little more than an interpolation although the body moves around it."""
    if source.stop - source.start < _MIN_MORPH_FRAMES or source.by == STANDING_STILL:
        return False
    first, end = max(0, source.start - 1), min(source.stop + 1, query.motion.num_frames)
    path_length, straight = (measure_path_length(each.slice(first, end)) for each in (made, query.motion))
    travelling = is_travelling(query.motion, max(0, source.start - 1), min(source.stop, len(query.missing.root) - 1))
    speed, straight_speed = (each * PRIOR_FPS / (source.stop - source.start) for each in (path_length, straight))
    still = straight_speed < _STILL_SPEED and _is_still_beside(query, source)
    return speed < max(_STILL_SPEED, _MORPH_RATIO * straight_speed) and (travelling or not still)


def _is_still_beside(query: GapQuery, source: GapSource) -> bool:
    """Return whether known frames beside a gap, if there are any, hardly move."""
    positions = query.motion.joint_positions()
    for one, other in ((source.start - 2, source.start - 1), (source.stop, source.stop + 1)):
        if one < 0 or other >= len(positions) or bool(query.missing.root[[one, other]].any()):
            continue
        if float((positions[other] - positions[one]).norm(dim=-1).mean()) * PRIOR_FPS > _STILL_SPEED:
            return False
    return True
