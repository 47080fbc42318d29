"""What the in-betweener is to make of a shot, and which of several ways to ask it a viewer would mind least."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool
from torch import Tensor

from controllers.common.map_refinement import estimate_rest_height
from controllers.inbetweening.pipeline import InfillSettings, fill
from mapctl import contacts
from mapctl.inbetweening.missing import MissingMask
from mapctl.metrics import worst_frame
from mapctl.motion import Motion
from mapctl.protocols import Inbetweener
from mapctl.skeleton import CANONICAL, TOES

_CONTEXT = 16  # frames on either side that the in-betweener is shown
_ACCELERATION_WEIGHT = 0.003  # m/s for a m/s^2 of the worst hand or toe
_SKATE_WEIGHT = 0.5  # of skating toes beside sliding of the support
_DETOUR_WEIGHT = 0.5  # of the trajectory's excess length over the straight one, m/s for m/s
_UNSUPPORTED_WEIGHT = 0.5  # of the longest time on no planted foot, m/s for a second
_SKATE_HEIGHT = 0.025  # metres
_TOES = CANONICAL.indices(TOES)
_EFFECTORS = CANONICAL.indices(("leftHand", "rightHand", *TOES))


@dataclass(frozen=True)
class Transition:
    """Frames start to stop between two spans, which the in-betweener makes."""

    start: int
    """First frame."""
    stop: int
    """One past the last frame."""


@dataclass(frozen=True, eq=False)
class Filling:
    """A shot's motion of which a part is to be made anew."""

    motion: Motion
    """All frames of the shot."""
    missing: MissingMask
    """What is to be made."""
    around: tuple[int, int]
    """Frames start to stop that it is within."""


def measure_transition_cost(before: Motion, after: Motion, one: Transition, inbetweener: Inbetweener) -> float:
    """Measure what a viewer would mind of a transition from one motion to another, both of the whole shot's frames,
    m/s (see `judge`)."""
    frame = torch.arange(before.num_frames)
    missing = MissingMask.of_frames((frame >= one.start) & (frame < one.stop), before.num_joints)
    return _measure_cost(Filling(join_across(before, after, one), missing, (one.start, one.stop)), inbetweener)


def choose_filling(candidates: Sequence[Filling], inbetweener: Inbetweener) -> int:
    """Choose the candidate that costs a viewer least (see `judge`). The in-betweener's proposals are compared, without
    MAP."""
    if len(candidates) == 1:
        return 0
    costs = [_measure_cost(one, inbetweener) for one in candidates]
    return costs.index(min(costs))


def _measure_cost(filling: Filling, inbetweener: Inbetweener) -> float:
    """Measure what a viewer would mind, m/s."""
    start, stop = filling.around
    first, last = max(0, start - _CONTEXT), min(filling.motion.num_frames, stop + _CONTEXT)
    gap = (max(1, start - first), min(stop, filling.motion.num_frames - 1) - first)
    part, missing = filling.motion.slice(first, last), filling.missing.slice(first, last)
    if not bool(missing.frames.any()):
        return 0.0
    done = fill(part, missing, inbetweener, settings=InfillSettings(finish=False))
    return judge(done.motion, done.contacts, gap)


def judge(motion: Motion, planted: Bool[Tensor, "frames 2"], gap: tuple[int, int]) -> float:
    """Judge a filled gap as a viewer would, m/s: sliding, skating, detours, time on no foot (see
    `compute_artefact_cost`), and the worst acceleration."""
    cost = compute_artefact_cost(motion, planted, gap)
    shown = motion.slice(max(0, gap[0] - 2), min(motion.num_frames, gap[1] + 2))
    peaks = worst_frame.measure_peaks(shown.joint_positions()[:, _EFFECTORS], shown.root_position, float(shown.fps))
    return cost + _ACCELERATION_WEIGHT * peaks.acceleration


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
    unsupported = worst_frame.measure_longest_unsupported(toes, hips, fps)
    return (
        slide
        + _SKATE_WEIGHT * skate
        + _DETOUR_WEIGHT * detour * fps / len(positions)
        + _UNSUPPORTED_WEIGHT * unsupported
    )


def join_across(before: Motion, after: Motion, transition: Transition) -> Motion:
    """Take frames before the transition from one motion, the others from another of as many frames."""
    earlier = torch.arange(before.num_frames) < transition.start
    return replace(
        before,
        root_position=torch.where(earlier[:, None], before.root_position, after.root_position),
        local_quat_xyzw=torch.where(earlier[:, None, None], before.local_quat_xyzw, after.local_quat_xyzw),
    )
