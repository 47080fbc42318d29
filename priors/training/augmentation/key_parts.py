"""Keys that tell less than whole poses (Zhou et al. 2020, section 5): halves, the hips alone, some joints, places on
the ground, and drawings seen from one side."""

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mapctl.numerics.intervals import true_intervals
from mapctl.skeleton import CANONICAL
from priors.tweening.keys import ToldParts

_JOINTS = CANONICAL.num_joints
_LEGS = frozenset(j for j, name in enumerate(CANONICAL.names) if name.endswith(("Leg", "Foot", "Toes")))


@dataclass(frozen=True)
class PartSettings:
    """How many sequences have keys that are not whole, and what these tell."""

    halves: float = 0.1
    """Share of sequences with keys of half a body, of the hips alone or of some joints."""
    places: float = 0.1
    """Share of sequences with keys that are nothing but places on the ground."""
    drawings: float = 0.1
    """Share of sequences with keys that are seen from one side."""


WHOLE = PartSettings(halves=0.0, places=0.0, drawings=0.0)
"""Keys are whole poses."""


def tell_parts(
    known: Bool[Tensor, "batch frames"],
    heading: Float[Tensor, "batch frames"],
    settings: PartSettings,
    rolls: Iterator[float],
) -> ToldParts:
    """Choose what is told in frames that are keys, of motions with these headings, radians: of most sequences all of
    the pose."""
    told = ToldParts.whole(known)
    axes, faced, view = told.axes.clone(), told.heading.clone(), told.view.clone()
    for row in range(len(known)):
        kind = next(rolls)
        runs = [slice(start, stop) for _, start, stop in true_intervals(known[row][:, None])]
        if not runs:
            continue
        if (kind := kind - settings.halves) < 0:
            for run in runs:
                axes[row, run] = _draw_part(rolls)[:, None]
        elif (kind := kind - settings.places) < 0:
            whole = 0.4 * (next(rolls) < 0.6)
            for run in runs:
                if next(rolls) >= whole:
                    axes[row, run], faced[row, run] = _PLACE, False
        elif kind - settings.drawings < 0:
            view[row] = _draw_view(float(heading[row, runs[0].start]), rolls)
            for run in runs:
                if next(rolls) < 0.75:
                    axes[row, run], faced[row, run] = False, False
                    axes[row, run.start] = _draw_drawing(rolls)
    return ToldParts(axes, faced, view)


def _see_joints(turning: Iterable[int]) -> Bool[Tensor, " joints"]:
    """Return which joints' positions are told by rotations of some."""
    told, rotations = [True], set(turning)
    for parent in CANONICAL.parents[1:]:
        told.append(told[parent] and parent in rotations)
    return torch.tensor(told)


_UPPER, _LOWER = (_see_joints({0, *part}) for part in (set(range(_JOINTS)) - _LEGS, _LEGS))
_HIPS = _see_joints({0})
_PLACE = torch.zeros(_JOINTS, 3, dtype=torch.bool)
_PLACE[0, ::2] = True


def _draw_part(rolls: Iterator[float]) -> Bool[Tensor, " joints"]:
    """Draw which joints are told of a key."""
    kind = next(rolls)
    for share, part in ((0.3, _UPPER), (0.3, _LOWER), (0.1, _HIPS), (0.15, torch.ones(_JOINTS, dtype=torch.bool))):
        if (kind := kind - share) < 0:
            return part
    return _see_joints({0} | {joint for joint in range(_JOINTS) if next(rolls) < 0.8})


def _draw_view(heading: float, rolls: Iterator[float]) -> float:
    """Draw from where somebody is seen, radians: half of the time from before, behind, the side or between these."""
    around = next(rolls)
    return heading + round(8 * around) * math.pi / 4 if next(rolls) < 0.5 else 2 * math.pi * around


def _draw_drawing(rolls: Iterator[float]) -> Bool[Tensor, "joints 3"]:
    """Draw which coordinates a drawing tells: two of all joints or of some; the third of the hips' if they are
    placed."""
    drawn = torch.ones(_JOINTS, dtype=torch.bool)
    if next(rolls) < 0.4:
        drawn = torch.tensor([next(rolls) < 0.7 for _ in range(_JOINTS)])
        drawn[0] = True
    axes = drawn[:, None] & torch.tensor([True, True, False])
    axes[0, 2] = next(rolls) < 0.5
    return axes
