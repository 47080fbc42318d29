"""What a user should know of every gap: who proposed the motion in it, how far such answers are from the truth, and
where nobody knows what happens.
"""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from controllers.inbetweening.canonical_gap import CanonicalGap
from controllers.inbetweening.error_estimates import TRAINED_GAP_FRAMES, ErrorEstimate, estimate_error, is_travelling
from controllers.inbetweening.proposers.answers import GapSource
from mapctl import rotations
from mapctl.features import PRIOR_FPS
from mapctl.kinematics import heading
from mapctl.motion import Motion

_MIN_CONTEXT_FRAMES = 8  # known frames on both sides that tell how somebody moves
_MORPH_RATIO, _MIN_MORPH_FRAMES = 1.3, 45
"""A motion that goes hardly further than straight from pose to pose, for so long, is no motion that somebody made."""
_STILL_SPEED = 0.12  # m/s of the joints of somebody who hardly moves: there is nothing to miss


def compose_gap_notes(gap: CanonicalGap, made: Motion, sources: Sequence[GapSource], *, fps: float) -> tuple[str, ...]:
    """A line for each gap, in frames of the motion at `fps`; short ones of one proposer share a line."""
    lines, short = [], {}
    for source in sources:
        sure = _estimate_gap_error(gap, source)
        text = _describe_gap(gap, made, source, sure)
        if text is None:
            short.setdefault(source.by, []).append((source, sure))
            continue
        lines.append(f"frames {_format_frames(gap, source, fps)}: {text}")
    for by, each in short.items():
        where = ", ".join(_format_frames(gap, source, fps) for source, _ in each)
        sure = max((sure for _, sure in each), key=lambda one: one.percentile_90_cm)
        lines.append(f"frames {where}: {by}, {sure.text}")
    return tuple(lines)


def _format_frames(gap: CanonicalGap, source: GapSource, fps: float) -> str:
    """Of the motion's own rate."""
    start, stop = (float(gap.seconds[frame]) for frame in (source.start - 1, min(source.stop, len(gap.seconds) - 1)))
    return f"{round(start * fps) + 1}:{round(stop * fps)}"


def _estimate_gap_error(gap: CanonicalGap, source: GapSource) -> ErrorEstimate:
    known = ~(gap.turns.any(dim=1) | gap.root)
    before, after = (
        known[max(0, source.start - _MIN_CONTEXT_FRAMES) : source.start],
        known[source.stop : source.stop + _MIN_CONTEXT_FRAMES],
    )
    beside = min(int(before.sum()), int(after.sum())) >= _MIN_CONTEXT_FRAMES
    going = is_travelling(gap.motion, max(0, source.start - 1), min(source.stop, len(known) - 1))
    return estimate_error(source.by, source.stop - source.start, going=going, beside=beside)


def _describe_gap(gap: CanonicalGap, made: Motion, source: GapSource, sure: ErrorEstimate) -> str | None:
    """What there is to say of one gap; None if it is but who proposed it and how sure that is."""
    words, seconds = [source.by, sure.text], (source.stop - source.start) / PRIOR_FPS
    if source.stop - source.start > TRAINED_GAP_FRAMES and source.by == "infiller":
        words.append(f"and {seconds:.1f} s are longer than the {TRAINED_GAP_FRAMES / PRIOR_FPS:.0f} s that it knows")
    if _is_morph(gap, made, source):
        words.append("a still morph: it goes hardly further than straight from one pose to the other; tell more keys")
    return ", ".join(words) if len(words) > 2 or source.by != "infiller" else None


def _is_morph(gap: CanonicalGap, made: Motion, source: GapSource) -> bool:
    """Whether nothing happens but one pose becoming the other, for long, where people move."""
    if source.stop - source.start < _MIN_MORPH_FRAMES or source.by == "standing still":
        return False
    part = slice(max(0, source.start - 1), source.stop + 1)
    way, straight = (
        _compute_path_length(each.joint_positions()[part], heading(each.local_quat_xyzw[part, 0]))
        for each in (made, gap.motion)
    )
    going = is_travelling(gap.motion, max(0, source.start - 1), min(source.stop, len(gap.root) - 1))
    pace, least = (each * PRIOR_FPS / (source.stop - source.start) for each in (way, straight))
    quiet = least < _STILL_SPEED and _is_still_beside(gap, source)
    return pace < max(_STILL_SPEED, _MORPH_RATIO * least) and (going or not quiet)


def _is_still_beside(gap: CanonicalGap, source: GapSource) -> bool:
    """Whether known frames beside a gap, if there are any, hardly move."""
    places = gap.motion.joint_positions()
    for one, other in ((source.start - 2, source.start - 1), (source.stop, source.stop + 1)):
        if one < 0 or other >= len(places) or bool(gap.root[[one, other]].any()):
            continue
        if float((places[other] - places[one]).norm(dim=-1).mean()) * PRIOR_FPS > _STILL_SPEED:
            return False
    return True


def _compute_path_length(places: Float[Tensor, "frames joints 3"], facing: Float[Tensor, " frames"]) -> float:
    """Of the joints seen from the hips, mean over joints, metres."""
    turn = rotations.about_y(-facing)[:, None].expand(-1, places.shape[1], 4)
    own = rotations.rotate(turn, places - places[:, :1])
    return float(torch.diff(own, dim=0).norm(dim=-1).sum(dim=0).mean())
