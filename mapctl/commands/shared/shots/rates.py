"""Shots at other rates than the prior's: what comes before and after them says how fast they are at their ends."""

from dataclasses import replace
from fractions import Fraction

import torch

from controllers.shots.request import ShotRequest
from controllers.shots.shot import ShotSolution
from mapctl.motion import Motion
from mapctl.recording.splines import resample_by_splines

_BESIDE = 6  # frames after the last


def resample_shot(solution: ShotSolution, request: ShotRequest, fps: Fraction) -> Motion:
    """Resample a shot's motion, a higher rate by splines: through the frames of a clip that it goes on from or ends in,
    and for a loop through its own, so that its last frame leads into its first at that rate."""
    motion = solution.motion
    before, after = request.lead.past if request.lead is not None else None, _find_after(solution, request)
    frames = round(motion.num_frames * fps / motion.fps) if request.loop else None
    frames = frames or int((motion.num_frames - 1) * fps / motion.fps) + 1
    whole = _join([before, motion, after])
    if fps <= motion.fps:
        return _join([motion, after]).resample(fps).slice(0, frames)
    first = 0 if before is None else before.num_frames
    seconds = (torch.arange(whole.num_frames, dtype=torch.float64) - first) / float(motion.fps)
    return resample_by_splines(whole, seconds, fps=fps, frames=frames)


def _find_after(solution: ShotSolution, request: ShotRequest) -> Motion | None:
    """Find the frames after the last, which is the first of a clip, or leads into the shot's first."""
    if request.loop:
        return solution.motion.slice(0, _BESIDE)
    if request.arrival is None:
        return None
    arrival = request.arrival.bring_to(solution.way.curve, float(solution.way.arcs[-1])).motion
    return arrival.slice(1, min(arrival.num_frames, 1 + _BESIDE))


def _join(parts: list[Motion | None]) -> Motion:
    there = [replace(part, moving_offsets={}) for part in parts if part is not None]
    whole = there[0]
    for part in there[1:]:
        whole = whole.join(part)
    return whole
