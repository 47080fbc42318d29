"""Notes on gaps: who proposed the motion in each, how far such proposals are from the truth, and where nothing but an
interpolation is proposed.
"""

from collections.abc import Sequence

from controllers.inbetweening.proposers.auto import STANDING_STILL
from mapctl.features import PRIOR_FPS
from mapctl.inbetweening import GapQuery, Proposal
from mapctl.inbetweening.query import GapSource
from mapctl.metrics.liveliness import measure_path_length
from mapctl.motion import Motion
from mapctl.skeleton import CANONICAL, leg_length

_INFILLER, _INFILLER_FRAMES = "infiller", 75
"""Name of the source whose longest gaps in training were of so many frames: their mean length and a deviation."""
_TRAVELLING_SPEED = 0.35  # m/s of hips with canonical legs, from one end of a gap to the other: a body that travels
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
    found = [answer.spread[one.start : one.stop] for one in sources if answer.spread is not None]
    sure = []
    if found and sources[0].by == answer.source:
        median, percentile_90 = max(
            (100 * each.mean(dim=(0, 1)) for each in found), key=lambda one: float(one[1])
        ).tolist()
        sure = [
            f"by its own estimate joints within {median:.1f} cm of the truth in half of cases and within"
            f" {percentile_90:.1f} cm in nine of ten"
        ]
    return f"frames {where}: {', '.join([sources[0].by, *sure, *remarks])}"


def _format_frames(query: GapQuery, source: GapSource, fps: float) -> str:
    """Format a gap in frames of the motion's own rate."""
    first = 0 if source.start == 0 else round(float(query.seconds[source.start - 1]) * fps) + 1
    last = len(query.seconds) - 1
    stop = round(float(query.seconds[min(source.stop, last)]) * fps)
    return f"{first}:{stop + (source.stop > last)}"


def _describe_gap(query: GapQuery, made: Motion, source: GapSource) -> list[str]:
    """List remarks on one gap beyond its proposer and error estimate."""
    remarks, seconds = [*filter(None, (source.reason, source.remark))], (source.stop - source.start) / PRIOR_FPS
    if source.stop - source.start > _INFILLER_FRAMES and source.by == _INFILLER:
        remarks.append(f"and {seconds:.1f} s are longer than the {_INFILLER_FRAMES / PRIOR_FPS:.0f} s that it knows")
    if _is_morph(query, made, source):
        remarks.append("a still morph: it goes hardly further than straight from one pose to the other; give more keys")
    return remarks


def is_travelling(motion: Motion, start: int, stop: int) -> bool:
    """Return whether the body (canonical joints) travels in a gap, faster than a shift of weight."""
    distance = float((motion.root_position[stop] - motion.root_position[start])[::2].norm())
    fastest_still = _TRAVELLING_SPEED * (stop - start) / float(motion.fps)
    return distance * leg_length(CANONICAL) / leg_length(motion.skeleton) > fastest_still


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
