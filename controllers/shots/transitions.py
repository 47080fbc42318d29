"""Transitions between standing and walking: when the first step begins and which foot takes the last one are tried,
and the in-betweener's answer that a viewer would mind least is taken.
"""

from collections.abc import Iterable
from dataclasses import dataclass, replace

import torch

from controllers.inbetweening.pipeline import fill
from controllers.inbetweening.proposers.auto import ChoiceSettings, compute_artefact_cost
from mapctl import contacts
from mapctl.inbetweening.missing import MissingMask
from mapctl.metrics import worst_frame
from mapctl.motion import Motion
from mapctl.protocols import Inbetweener
from mapctl.skeleton import CANONICAL, TOES

_CONTEXT = 16  # frames on either side that the in-betweener is shown
_ACCELERATION_WEIGHT = 0.003  # m/s for a m/s^2 of the worst hand or toe
_EFFECTORS = CANONICAL.indices(("leftHand", "rightHand", *TOES))


@dataclass(frozen=True)
class Transition:
    """Frames start to stop between two spans, which the in-betweener makes."""

    start: int
    """First frame."""
    stop: int
    """One past the last frame."""


def choose_transition(
    before: Motion, after: Motion, candidates: Iterable[Transition], inbetweener: Inbetweener
) -> tuple[Transition, float]:
    """Choose the transition from one motion to another, both of the whole shot's frames, that costs a viewer least:
    sliding, skating, detours, time on no foot (see `compute_artefact_cost`), and the worst acceleration; m/s.
    """
    found: list[tuple[float, Transition]] = []
    for one in candidates:
        first, last = max(0, one.start - _CONTEXT), min(before.num_frames, one.stop + _CONTEXT)
        gap = (one.start - first, one.stop - first)
        joined = join_across(before, after, one).slice(first, last)
        missing = torch.zeros(last - first, dtype=torch.bool)
        missing[gap[0] : gap[1]] = True
        done = fill(joined, MissingMask.of_frames(missing, joined.num_joints), inbetweener)
        cost = compute_artefact_cost(done.motion, contacts.to_logits(done.contacts), gap, ChoiceSettings())
        shown = done.motion.slice(max(0, gap[0] - 2), gap[1] + 2)
        peaks = worst_frame.measure_peaks(shown.joint_positions()[:, _EFFECTORS], shown.root_position, float(shown.fps))
        found.append((cost + _ACCELERATION_WEIGHT * peaks.acceleration, one))
    cost, best = min(found, key=lambda each: each[0])
    return best, cost


def join_across(before: Motion, after: Motion, transition: Transition) -> Motion:
    """Take frames before the transition from one motion, the others from another of as many frames."""
    earlier = torch.arange(before.num_frames) < transition.start
    return replace(
        before,
        root_position=torch.where(earlier[:, None], before.root_position, after.root_position),
        local_quat_xyzw=torch.where(earlier[:, None, None], before.local_quat_xyzw, after.local_quat_xyzw),
    )
