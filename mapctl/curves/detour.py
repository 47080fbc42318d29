"""Leading a curve around what is in its way: the least sideways offset at each arc that keeps clear."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import scipy
import torch
from jaxtyping import Bool, Float
from numpy import ndarray
from torch import Tensor

from mapctl import curves
from mapctl.curves.curve import Curve

ClearanceOf = Callable[[Float[Tensor, "arcs offsets 2"], Float[Tensor, " arcs"]], Float[Tensor, "arcs offsets"]]
"""Ground points and their arcs to the distance by which they are clear, metres; negative where nobody may walk."""


@dataclass(frozen=True)
class DetourSettings:
    """How far a detour may lead, and what it costs."""

    widest: float = 3.0
    """Largest sideways offset, metres."""
    spacing: float = 0.05
    """Metres between the arcs at which offsets are chosen."""
    step: float = 0.025
    """Metres between the offsets that are tried."""
    steepest: float = 1.0
    """Largest change of the offset per metre of arc."""
    decay: float = 0.6
    """Metres of arc over which an offset that is no longer needed falls by a factor of e."""
    bend: float = 0.5
    """Metres of arc over which a detour bends: the square root of what bending costs beside the offset."""


def find_detour(
    curve: Curve, clearance: ClearanceOf, settings: DetourSettings | None = None
) -> Float[Tensor, " arcs"] | None:
    """Find sideways offsets, metres to the left, at arcs `settings.spacing` apart, under which a curve keeps clear.

    Dynamic programming over the arcs: the sum of squared offsets and slopes is least among all ways on the grid, so
    that left or right of each obstacle is chosen for the whole way. The offset at the start is 0, and so is that at the
    end, where that is free. None where no way leads through.
    """
    settings = settings or DetourSettings()
    arcs = torch.linspace(0, curve.length, max(2, round(curve.length / settings.spacing) + 1), dtype=torch.float64)
    count = 2 * round(settings.widest / settings.step) + 1
    offsets = torch.linspace(-settings.widest, settings.widest, count, dtype=torch.float64)
    free = _find_free(curve, arcs, offsets, clearance).numpy()
    chosen = _choose_offsets(free, offsets.numpy(), settings)
    if chosen is None:
        return None
    return torch.from_numpy(_smooth_offsets(free, offsets.numpy(), chosen, settings))


def apply_detour(curve: Curve, offsets: Float[Tensor, " arcs"]) -> Curve:
    """Return the curve moved sideways by offsets at evenly spaced arcs, as `find_detour` returns them."""
    if not bool((offsets.abs() > 1e-3).any()):
        return curve
    fine = torch.linspace(0, curve.length, max(2, round(curve.length / 0.02)), dtype=torch.float64)
    moved = curve.point(fine).clone()
    moved[:, curve.ground_axes] = find_ground_beside(curve, offsets, fine)
    return curves.from_points(moved, closed=False)


def find_ground_beside(
    curve: Curve, offsets: Float[Tensor, " knots"], arcs: Float[Tensor, " arcs"]
) -> Float[Tensor, "arcs 2"]:
    """Find where arcs of a curve, metres, are on the ground once it is moved sideways by offsets at evenly spaced
    arcs, as `find_detour` returns them."""
    between = interpolate_evenly(curve, offsets, arcs)
    return _ground_points(curve, arcs, between[:, None])[:, 0]


def interpolate_evenly(
    curve: Curve, values: Float[Tensor, " knots"], arcs: Float[Tensor, " arcs"]
) -> Float[Tensor, " arcs"]:
    """Interpolate values at evenly spaced arcs of a curve to others, metres."""
    knots = torch.linspace(0, curve.length, len(values), dtype=torch.float64)
    return torch.from_numpy(np.interp(arcs.numpy(), knots.numpy(), values.numpy()))


def _ground_points(
    curve: Curve, arcs: Float[Tensor, " arcs"], offsets: Float[Tensor, "arcs offsets"]
) -> Float[Tensor, "arcs offsets 2"]:
    return curve.ground_point(arcs)[:, None] + offsets[..., None] * curve.left(arcs)[:, None]


def _find_free(curve: Curve, arcs: Tensor, offsets: Tensor, clearance: ClearanceOf) -> Bool[Tensor, "arcs offsets"]:
    return clearance(_ground_points(curve, arcs, offsets.expand(len(arcs), -1)), arcs) >= 0


def _choose_offsets(free: ndarray, offsets: ndarray, settings: DetourSettings) -> ndarray | None:
    """Choose the number of the cheapest offset at each arc; None where every way is blocked."""
    reach = max(1, round(settings.steepest * settings.spacing / settings.step))
    slopes = np.arange(-reach, reach + 1) * settings.step / settings.spacing
    cost, came_from = np.full(len(offsets), np.inf), []
    cost[len(offsets) // 2] = 0.0 if free[0, len(offsets) // 2] else np.inf
    for row in free[1:]:
        padded = np.pad(cost, reach, constant_values=np.inf)
        ways = np.stack([padded[k : k + len(offsets)] for k in range(2 * reach + 1)])
        ways += (settings.decay * slopes[:, None]) ** 2
        best = ways.argmin(axis=0)
        cost = np.where(row, ways[best, np.arange(len(offsets))] + offsets**2, np.inf)
        came_from.append(best - reach)
    if not np.isfinite(cost).any():
        return None
    middle = len(offsets) // 2
    at = middle if np.isfinite(cost[middle]) else int(cost.argmin())  # it ends where the curve does, if that is free
    chosen = [at]
    for back in reversed(came_from):
        at += int(back[at])
        chosen.append(at)
    return np.array(chosen[::-1])


def _smooth_offsets(free: ndarray, offsets: ndarray, chosen: ndarray, settings: DetourSettings) -> ndarray:
    """Minimise offsets, slopes and bends between the walls on either side of the chosen way."""
    lowest, highest = np.empty(len(chosen)), np.empty(len(chosen))
    for arc, (row, at) in enumerate(zip(free, chosen, strict=True)):
        walls = np.flatnonzero(~row)
        below, above = walls[walls < at], walls[walls > at]
        lowest[arc] = offsets[below[-1] + 1] if len(below) else offsets[0]
        highest[arc] = offsets[above[0] - 1] if len(above) else offsets[-1]
    lowest[0] = highest[0] = 0.0
    lowest[-1] = highest[-1] = offsets[chosen[-1]]
    widened = np.maximum(highest, lowest + 1e-6)  # the solver wants some room
    line = np.eye(len(chosen))
    slopes, bends = np.diff(line, axis=0) / settings.spacing, np.diff(line, 2, axis=0) / settings.spacing**2
    rows = np.concatenate([line, settings.decay * slopes, settings.bend**2 * bends])
    wanted = scipy.sparse.csr_array(rows)
    return scipy.optimize.lsq_linear(wanted, np.zeros(len(rows)), bounds=(lowest, widened), tol=1e-8).x
