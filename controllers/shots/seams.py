"""In-betweening within a walked motion: transitions between its spans, seams of loops and clips.

Where a transition lies is a choice with several basins: a few frames earlier another foot is in the air. A grid is
tried, and the proposal with the least visible artefacts is taken.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise, product

import torch
from jaxtyping import Bool
from torch import Tensor

from controllers.common.map_refinement import estimate_rest_height
from controllers.inbetweening.pipeline import fill
from controllers.shots.footsteps import Displacement, Footstep, LastSteps, plan_footsteps, take_given, take_steps
from controllers.shots.request import Arrival, Lead
from controllers.shots.trajectory import Span, Trajectory
from controllers.shots.walk import Piece
from mapctl import contacts
from mapctl.metrics import body
from mapctl.motion import Motion
from mapctl.numerics.intervals import true_intervals
from mapctl.protocols import Inbetweener
from mapctl.recording.masks import MissingMask
from mapctl.skeleton import CANONICAL, TOES

_CONTEXT = 16  # frames on either side that the in-betweener is given
_ACCELERATION_WEIGHT = 0.003  # m/s for a m/s^2 of the worst hand or toe
_SKATE_WEIGHT = 0.5  # of skating toes beside sliding of the support
_DETOUR_WEIGHT = 0.5  # of the trajectory's excess length over the straight one, m/s for m/s
_UNSUPPORTED_WEIGHT = 0.5  # of the longest time on no planted foot, m/s for a second
_TRIED_TRANSITIONS, _NEARLY = 12, 0.03  # transitions tried of those whose steps are strained least, or 3 cm more
_SKATE_HEIGHT = 0.025  # metres
_TOES = CANONICAL.indices(TOES)
_EFFECTORS = CANONICAL.indices(("leftHand", "rightHand", *TOES))


@dataclass(frozen=True, eq=False)
class Filling:
    """A shot's motion of which the in-betweener is to generate a part."""

    motion: Motion
    """All frames of the shot."""
    missing: MissingMask
    """The part."""
    around: tuple[int, int]
    """Frames start to stop that it is within."""

    @staticmethod
    def of_frames(motion: Motion, start: int, stop: int) -> "Filling":
        """Return the filling of whole frames from start to stop."""
        frame = torch.arange(motion.num_frames)
        missing = MissingMask.of_frames((frame >= start) & (frame < stop), motion.num_joints)
        return Filling(motion, missing, (start, stop))

    def cost(self, inbetweener: Inbetweener) -> float:
        """Compute the cost of what is visible of the in-betweener's proposal, m/s: sliding, skating, detours, time on
        no foot (see `compute_artefact_cost`), and the worst acceleration."""
        start, stop = self.around
        first, last = max(0, start - _CONTEXT), min(self.motion.num_frames, stop + _CONTEXT)
        gap = (max(1, start - first), min(stop, self.motion.num_frames - 1) - first)
        part, missing = self.motion.slice(first, last), self.missing.slice(first, last)
        planted = contacts.detect_contacts(part.joint_positions()[:, _TOES], part.fps)
        if bool(missing.frames.any()):
            done = fill(part, missing, inbetweener, refinement=None)
            part, planted = done.motion, done.contacts
        shown = part.slice(max(0, gap[0] - 2), min(part.num_frames, gap[1] + 2))
        peaks = body.measure_peaks(shown.joint_positions()[:, _EFFECTORS], shown.root_position, float(shown.fps))
        return compute_artefact_cost(part, planted, gap) + _ACCELERATION_WEIGHT * peaks.acceleration


def choose_filling(candidates: Sequence[Filling], inbetweener: Inbetweener) -> int:
    """Choose the candidate of the least cost, by the in-betweener's proposals without MAP."""
    return min(range(len(candidates)), key=lambda at: candidates[at].cost(inbetweener)) if len(candidates) > 1 else 0


def compute_artefact_cost(motion: Motion, planted: Bool[Tensor, "frames 2"], gap: tuple[int, int]) -> float:
    """Compute the cost of visible artefacts in a filled gap as a speed, m/s: sliding of the support, skating toes, a
    detour, the longest unsupported time.
    """
    start, stop = gap[0] - 1, gap[1] + 1
    positions, fps = motion.joint_positions()[start:stop], float(motion.fps)
    toes, hips = positions[:, _TOES], positions[:, 0]
    height = estimate_rest_height(motion, contacts.debounced(planted))[start:stop]
    above, speeds = (toes[..., 1] - height)[1:], torch.diff(toes[..., ::2], dim=0).norm(dim=-1) * fps
    slide = float(contacts.support_speed(above, speeds).mean())
    skate = float((speeds * (1 - above / _SKATE_HEIGHT).clamp(0, 1)).mean())
    ground = hips[:, ::2]
    detour = float(torch.diff(ground, dim=0).norm(dim=-1).sum()) - float((ground[-1] - ground[0]).norm())
    unsupported = body.measure_longest_unsupported(toes, hips, fps)
    return (
        slide
        + _SKATE_WEIGHT * skate
        + _DETOUR_WEIGHT * detour * fps / len(positions)
        + _UNSUPPORTED_WEIGHT * unsupported
    )


def _join_across(before: Motion, after: Motion, frame: int) -> Motion:
    """Take the frames before one from one motion, the others from another of as many frames."""
    earlier = torch.arange(before.num_frames) < frame
    return replace(
        before,
        root_position=torch.where(earlier[:, None], before.root_position, after.root_position),
        local_quat_xyzw=torch.where(earlier[:, None, None], before.local_quat_xyzw, after.local_quat_xyzw),
    )


def _insert(motion: Motion, part: Motion, start: int) -> Motion:
    """Replace the frames from `start` on by those of a part."""
    frames = slice(start, start + part.num_frames)
    root, quats = motion.root_position.clone(), motion.local_quat_xyzw.clone()
    root[frames], quats[frames] = part.root_position.to(root), part.local_quat_xyzw.to(quats)
    return replace(motion, root_position=root, local_quat_xyzw=quats)


def fill_frames(motion: Motion, missing: Bool[Tensor, " frames"], inbetweener: Inbetweener) -> Motion:
    """Generate whole frames of a motion."""
    return fill(motion, MissingMask.of_frames(missing, motion.num_joints), inbetweener).motion


_STILL_START, _STILL_END = 12, 26  # frames of standing at least, where a shot begins and ends with it
_SHORTEST = 12  # frames of a transition
_HASTY = 20  # frames of a transition for which there is no room
_SETTLED = 8  # frames that are left of a walk between two transitions


@dataclass(frozen=True, eq=False)
class JoinedPieces:
    """Pieces joined to one motion, of which the in-betweener is to generate a part."""

    motion: Motion
    """All frames of the shot."""
    missing: Bool[Tensor, " frames"]
    """Frames that the in-betweener is to generate."""
    first_steps: tuple[tuple[int, int], ...]
    """Frames start to stop of transitions from a stand to a walk."""
    last_steps: tuple[tuple[int, int], ...]
    """Frames start to stop of transitions from a walk to a stand."""

    def settle(self, motion: Motion) -> Motion:
        """Let feet step where transitions have been generated: a foot stands while the other one swings."""
        for start, stop in self.last_steps:
            motion = _insert(motion, LastSteps(motion, start - 1, stop).take(), start - 1)
        for start, stop in self.first_steps:  # backward in time a first step is a last one
            frames = motion.num_frames
            last = LastSteps(motion.reverse(), frames - 1 - stop, frames - start)
            motion = _insert(motion, last.take().reverse(), start - 1)
        return motion


def join_pieces(
    pieces: Sequence[Piece], trajectory: Trajectory, inbetweener: Inbetweener, footsteps: Sequence[Footstep] = ()
) -> JoinedPieces:
    """Join pieces: two stands by footsteps, planned where none are given there, others by the transitions that cost
    least."""
    joined = pieces[0].motion
    missing = torch.zeros(joined.num_frames, dtype=torch.bool)
    earliest, first_steps, last_steps = 0, list[tuple[int, int]](), list[tuple[int, int]]()
    for before, after in pairwise(pieces):
        if before.span.what == after.span.what == "stand":
            start, steps = _step_across(before, after, trajectory, earliest, footsteps)
            stop = start + steps.num_frames - 1
            joined = _insert(_join_across(joined, after.motion, stop), steps, start)
            earliest = stop
            continue
        stops = after.span.what == "stand"
        candidates = _keep_comfortable(
            [
                Filling.of_frames(_join_across(joined, after.motion, start), start, stop)
                for start, stop in _lay_transitions(before.span, after.span, joined.num_frames, earliest)
            ],
            stops=stops,
        )
        chosen = candidates[choose_filling(candidates, inbetweener)]
        joined, (start, stop) = chosen.motion, chosen.around
        missing[start:stop] = True
        if before.span.what != after.span.what:
            (last_steps if stops else first_steps).append((start, stop))
        earliest = stop + _SETTLED
    return JoinedPieces(joined, missing, tuple(first_steps), tuple(last_steps))


def _keep_comfortable(candidates: Sequence[Filling], *, stops: bool) -> list[Filling]:
    """Return the transitions between walk and stand whose steps are the least strained, or nearly."""
    strains = []
    for candidate in candidates:
        (start, stop), motion = candidate.around, candidate.motion
        if not stops:
            motion, start, stop = motion.reverse(), motion.num_frames - stop, motion.num_frames + 1 - start
        strains.append(LastSteps(motion, start - 1, stop).measure_strain())
    order = sorted(range(len(strains)), key=lambda at: strains[at])
    return [candidates[at] for at in order[:_TRIED_TRANSITIONS] if strains[at] <= strains[order[0]] + _NEARLY]


def _step_across(
    before: Piece, after: Piece, trajectory: Trajectory, earliest: int, footsteps: Sequence[Footstep]
) -> tuple[int, Motion]:
    """Step from one stand to the next along a trajectory; return the first frame and the motion. Where speeds give too
    little time, the stands do."""
    frames = after.motion.num_frames
    first = max(earliest, before.span.start + (_STILL_START if before.span.start == 0 else 1))
    latest = frames - _STILL_END if after.span.stop == frames else after.span.stop - 1
    left, reached = before.span.stop - 1, after.span.start
    ends = [piece.motion.slice(at, at + 1) for piece, at in ((before, left), (after, reached))]
    displacement = Displacement.along(trajectory.curve, trajectory.arcs[[left, reached]], ends[0], ends[1])
    short = displacement.count_frames() - (reached - left + 1)
    start = max(min(left, first), left - max(0, short) // 2)
    stop = min(max(reached, latest), start + max(reached - start, displacement.count_frames() - 1))
    given = [step for step in footsteps if start <= step.lift and step.land <= stop]
    plan = take_given(given, start) if given else plan_footsteps(displacement, stop - start + 1)
    return start, take_steps(displacement, plan, stop - start + 1)


def _lay_transitions(before: Span, after: Span, frames: int, earliest: int) -> list[tuple[int, int]]:
    """List the transitions from one span to the next, frames start to stop, that leave enough of both; where none does,
    one as late as the stand after it allows."""
    own = before.start + (_SETTLED if before.what == "walk" else _STILL_START if before.start == 0 else 1)
    first, latest, hasty = max(earliest, own), after.stop - 1, min(after.start + 1, after.stop - 1)
    if after.what == "stand" and after.stop == frames:
        latest, hasty = min(latest, frames - _STILL_END), min(hasty, frames - _STILL_END)
    if before.what == "walk":
        grid = product(range(-20, 9, 2), (26, 34))
        tried = [(before.stop + step, before.stop + step + length) for step, length in grid]
    else:
        # From standing to walking one may begin at once; from a stand to the next there may be more than a step.
        longest = after.start - (first if after.what == "walk" else before.stop)
        grid = product(range(0, 17, 2), sorted({18, 26, longest}))
        tried = [(after.start + step - length, after.start + step) for step, length in grid]
    found = [(start, stop) for start, stop in tried if first <= start and stop <= latest and stop - start >= _SHORTEST]
    start = max(earliest, min(before.stop - 1, hasty - _HASTY))
    return found or [(start, max(start + 1, hasty))]


_REST, _SOON = 24, 45  # frames in which limbs come to rest, or until the first step where it ends that soon
_SEAMS = (0, 10, 18, 26)  # frames after a clip's last that are tried as its seam


def go_on(motion: Motion, missing: Bool[Tensor, " frames"], lead: Lead, inbetweener: Inbetweener) -> Motion:
    """Generate the missing frames of a shot that continues from a clip, and those after the clip's last, by the motion
    before it: where that ends in a gesture, limbs come to rest until the first step; where it walks in a style that the
    density does not know, a seam costs a viewer less than a jump."""
    past = lead.past
    count = past.num_frames
    if lead.gestures:
        first = next(((start, stop) for _, start, stop in true_intervals(missing[:, None].clone())), None)
        rest = first[1] if first is not None and first[0] < _SOON else min(_REST, motion.num_frames - 1)
        missing = missing.clone()
        missing[1:rest] = True
        whole = fill_frames(past.join(motion), torch.cat([missing.new_zeros(count), missing]), inbetweener)
    else:
        whole = past.join(fill_frames(motion, missing, inbetweener) if bool(missing.any()) else motion)
        if not lead.stands:
            tried = [Filling.of_frames(whole, count + 1, count + 1 + width) for width in _SEAMS]
            whole = _fill_best(
                [replace(each, around=(count + 1, count + 1 + max(_SEAMS))) for each in tried], inbetweener
            )
    return whole.slice(count, whole.num_frames)


def arrive(motion: Motion, arrival: Arrival, inbetweener: Inbetweener) -> Motion:
    """Generate the last steps of a shot's motion anew so that it ends in an arrival, which is in position; a motion
    that ends there already stays."""
    last = motion.num_frames - 1
    off = motion.slice(last, last + 1).joint_positions() - arrival.motion.slice(0, 1).joint_positions()
    if float(off.norm(dim=-1).max()) < 1e-3:
        return motion
    longer = replace(
        motion,
        root_position=torch.cat([motion.root_position[:-1], arrival.motion.root_position]),
        local_quat_xyzw=torch.cat([motion.local_quat_xyzw[:-1], arrival.motion.local_quat_xyzw]),
    )
    tried = [Filling.of_frames(longer, max(1, last - width), last) for width in (18, 26, 36, 50)]
    return _fill_best(tried, inbetweener).slice(0, last + 1)


def _fill_best(tried: Sequence[Filling], inbetweener: Inbetweener) -> Motion:
    chosen = tried[choose_filling(tried, inbetweener)]
    if not bool(chosen.missing.frames.any()):
        return chosen.motion
    return fill(chosen.motion, chosen.missing, inbetweener).motion


OVERLAP = 54
"""Frames, at PRIOR_FPS, that a walk goes on for after once around."""
_EARLIEST, _LATEST = 16, 44  # frames after the first at which laps may be joined: about a stride
_TRIED = 3  # of the best of them


def close_loop(motion: Motion, frames: int, inbetweener: Inbetweener) -> Motion:
    """Return one lap of so many frames of a walk that goes on for OVERLAP more: its second lap's first frames, and then
    the first lap's from where both are most alike."""
    positions = motion.joint_positions()
    laps = [positions[start:].flatten(1) for start in (0, frames)]
    here, later = (torch.cat([lap[1:], 3.0 * torch.diff(lap, dim=0)], dim=-1) for lap in laps)
    count = min(len(here), len(later))
    unlike = (here[:count] - later[:count]).norm(dim=-1)
    tried = []
    for seam in (unlike[_EARLIEST:_LATEST].argsort()[:_TRIED] + _EARLIEST).tolist():
        source = torch.arange(frames)
        source[:seam] += frames
        joined = replace(
            motion, root_position=motion.root_position[source], local_quat_xyzw=motion.local_quat_xyzw[source]
        )
        tried += [Filling.of_frames(joined, seam - width, seam + width) for width in (3, 6, 10)]
    return _fill_best(tried, inbetweener)
