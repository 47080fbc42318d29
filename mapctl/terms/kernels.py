"""Compiled energies of terms with their gradients (imported late: needs numba). Arithmetic is float64 throughout.

Each kernel is the adjoint of one term, whose torch form is the specification: it fills the energies (batch, frames) and
adds to the gradients. Local frames of curves are the positions and directions of `Curve.nearest`, `Curve.point`,
`Curve.tangent` and `Curve.left`, which are their specification, in one compiled pass.
"""

# pyright: basic
# (numba infers the types)

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from mapctl.curves import Curve
from mapctl.numerics.jit import make_jit_decorators

entry, inner = make_jit_decorators("contract", "nsz")

_NEVER = -2  # below every frame


@entry
def add_latent_prior(noise, sigma, energy, d_noise):
    """Normal noise: half the squared numbers over sigma squared."""
    weight = 1.0 / (sigma * sigma)
    for b in range(len(noise)):
        for t in range(noise.shape[1]):
            total = 0.0
            for j in range(noise.shape[2]):
                value = np.float64(noise[b, t, j])
                total += value * value
                d_noise[b, t, j] += weight * value
            energy[b, t] = 0.5 * weight * total


@inner
def step_of(joints, before, b, t, joint, k):
    """Displacement of a joint along an axis since the frame before, metres; 0 where there is none."""
    now = np.float64(joints[b, t, joint, k])
    if t > 0:
        return now - np.float64(joints[b, t - 1, joint, k])
    return now - np.float64(before[0, joint, k]) if len(before) else 0.0


@entry
def add_contact(points, before, planted, pair, fps, sigmas, rest_heights, doubt, energy, d_points):
    """Two planted points rest and are on the ground, neither is below it; added to the energies. `before` (0 or 1,
    points, 3) is the last frame before the window, `planted` (batch, 1 + frames, 2) begins there; `pair` are their
    columns, `sigmas` are speed, height and depth, `rest_heights` is (frames, 2). From `doubt` nats on a contact counts
    less and less; 0 for never."""
    travel, height = (fps / sigmas[0]) ** 2, 1.0 / sigmas[1] ** 2
    below = 1.0 / sigmas[2] ** 2
    for b in range(len(points)):
        for t in range(points.shape[1]):
            for side in range(2):
                point = pair[side]
                above = np.float64(points[b, t, point, 1]) - rest_heights[t, side]
                if above < 0.0:
                    energy[b, t] += 0.5 * below * above * above
                    d_points[b, t, point, 1] += below * above
                if not planted[b, t + 1, side]:
                    continue
                stays, x, z = planted[b, t, side], 0.0, 0.0
                held = 0.5 * height * above * above
                if stays:
                    x, z = step_of(points, before, b, t, point, 0), step_of(points, before, b, t, point, 2)
                    held += 0.5 * travel * (x * x + z * z + 1e-12)
                share = doubt / (doubt + held) if doubt > 0.0 else 1.0
                energy[b, t] += doubt * math.log1p(held / doubt) if doubt > 0.0 else held
                d_points[b, t, point, 1] += share * height * above
                x, z = share * travel * x, share * travel * z
                d_points[b, t, point, 0] += x
                d_points[b, t, point, 2] += z
                if t > 0:
                    d_points[b, t - 1, point, 0] -= x
                    d_points[b, t - 1, point, 2] -= z


@entry
def add_landing(points, before, pair, fps, sigmas, energy, d_points):
    """Accelerations of two points beyond what is free, over a sigma; added to the energies. `before` (0 to 2 frames,
    points, 3) comes before the window; without it the first frames have no acceleration."""
    known, squared = len(before), fps * fps
    for b in range(len(points)):
        for t in range(max(0, 2 - known), points.shape[1]):
            for side in range(2):
                point, size = pair[side], 1e-9
                for k in range(3):
                    size += acceleration_of(points, before, b, t, point, k) ** 2
                size = squared * math.sqrt(size)
                beyond = (size - sigmas[0]) / sigmas[1]
                if beyond <= 0.0:
                    continue
                energy[b, t] += 0.5 * beyond * beyond
                for k in range(3):
                    pull = beyond / sigmas[1] * squared * squared / size
                    pull *= acceleration_of(points, before, b, t, point, k)
                    d_points[b, t, point, k] += pull
                    if t > 0:
                        d_points[b, t - 1, point, k] -= 2.0 * pull
                    if t > 1:
                        d_points[b, t - 2, point, k] += pull


@inner
def acceleration_of(points, before, b, t, point, k):
    """Second difference of a point along an axis, metres, from frames that are known."""
    now, known = np.float64(points[b, t, point, k]), len(before)
    last = np.float64(points[b, t - 1, point, k]) if t > 0 else np.float64(before[known - 1, point, k])
    earlier = np.float64(points[b, t - 2, point, k]) if t > 1 else np.float64(before[known - 2 + t, point, k])
    return now - 2.0 * last + earlier


@entry
def add_root_velocity(ground, start, known, weights, velocities, units, fps, energy, d_ground):
    """The low-pass velocity is the target's. `known` and `weights` are the smoother's part of the past and of the
    window, `units` (frames, 2, 2) the axes of the error over their sigmas."""
    frames = ground.shape[1]
    raw, pulled, d_raw = np.empty((frames, 2)), np.empty(2), np.empty((frames, 2))
    for b in range(len(ground)):
        for t in range(frames):
            for k in range(2):
                last = np.float64(ground[b, t - 1, k]) if t > 0 else np.float64(start[b, k])
                raw[t, k] = (np.float64(ground[b, t, k]) - last) * fps - velocities[t, k]
        d_raw[:] = 0.0
        for t in range(frames):
            x, z = np.float64(known[t, 0]), np.float64(known[t, 1])
            for s in range(frames):
                x += weights[t, s] * raw[s, 0]
                z += weights[t, s] * raw[s, 1]
            along = x * units[t, 0, 0] + z * units[t, 0, 1]
            across = x * units[t, 1, 0] + z * units[t, 1, 1]
            energy[b, t] = 0.5 * (along * along + across * across)
            pulled[0] = along * units[t, 0, 0] + across * units[t, 1, 0]
            pulled[1] = along * units[t, 0, 1] + across * units[t, 1, 1]
            for s in range(frames):
                d_raw[s, 0] += weights[t, s] * pulled[0]
                d_raw[s, 1] += weights[t, s] * pulled[1]
        for t in range(frames):
            for k in range(2):
                d_ground[b, t, k] += fps * (d_raw[t, k] - (d_raw[t + 1, k] if t + 1 < frames else 0.0))


@entry
def add_facing(heading, facing, sigma, energy, d_heading):
    """The heading is the target's, up to whole turns; added to the energies."""
    weight = 1.0 / (sigma * sigma)
    for b in range(len(heading)):
        for t in range(heading.shape[1]):
            apart = np.float64(heading[b, t]) - facing[t]
            apart -= 2.0 * math.pi * np.rint(apart / (2.0 * math.pi))
            energy[b, t] += 0.5 * weight * apart * apart
            d_heading[b, t] += weight * apart


@inner
def shrink(value, free):
    """Return the excess of a value over its dead zone."""
    return value - free if value > free else (value + free if value < -free else 0.0)


@entry
def add_path(positions, extension, axes, known, weights, sigmas, sigma_slow, free_sway, energy, d_positions):
    """Offsets from a curve that is held: sideways beyond the free sway, forward, in space upward (`sigmas`), and the
    slow part of the sideways offset. `weights` (frames from, frames to) smooth it, `known` is what the past adds."""
    frames, dims = positions.shape[1], positions.shape[2]
    offsets, d_offsets = np.empty((frames, dims)), np.empty((frames, dims))
    for b in range(len(positions)):
        for t in range(frames):
            total = 0.0
            for axis in range(dims):
                offset = 0.0
                for k in range(dims):
                    apart = np.float64(positions[b, t, k]) - np.float64(extension[b, t, k])
                    offset += apart * np.float64(axes[b, t, axis, k])
                offsets[t, axis] = offset
                error = (shrink(offset, free_sway) if axis == 0 else offset) / sigmas[axis]
                total += error * error
                d_offsets[t, axis] = error / sigmas[axis]
            energy[b, t] = 0.5 * total
        for t in range(frames):
            slow = np.float64(known[t])
            for s in range(frames):
                slow += offsets[s, 0] * weights[s, t]
            error = slow / sigma_slow
            energy[b, t] += 0.5 * error * error
            for s in range(frames):
                d_offsets[s, 0] += weights[s, t] * error / sigma_slow
        for t in range(frames):
            for k in range(dims):
                total = 0.0
                for axis in range(dims):
                    total += d_offsets[t, axis] * np.float64(axes[b, t, axis, k])
                d_positions[b, t, k] += total


@inner
def visit_touch_downs(joints, before, planted, toes, length, b, errors, weight, d_joints):
    """Go through the touch-downs of a candidate: with weight 0 sum the errors of step length by frame, else add the
    gradient that these sums have."""
    apart = np.empty(2)
    for side in range(2):
        toe, other, last = toes[side], toes[1 - side], _NEVER
        if planted[b, 0, 1 - side] and len(before) > 0:
            last = -1
        for t in range(joints.shape[1]):
            if planted[b, t + 1, 1 - side]:
                last = t
            if not planted[b, t + 1, side] or planted[b, t, side] or last == _NEVER:
                continue
            for k in range(2):
                foot = before[0, other, 2 * k] if last < 0 else joints[b, last, other, 2 * k]
                apart[k] = np.float64(joints[b, t, toe, 2 * k]) - np.float64(foot)
            distance = math.sqrt(apart[0] * apart[0] + apart[1] * apart[1] + 1e-12)
            if weight == 0.0:
                errors[t] += distance - length
                continue
            for k in range(2):
                pulled = weight * errors[t] * apart[k] / distance
                d_joints[b, t, toe, 2 * k] += pulled
                if last >= 0:
                    d_joints[b, last, other, 2 * k] -= pulled


@entry
def add_step_length(joints, before, planted, toes, length, sigma, energy, d_joints):
    """A toe that touches down is at a distance from where the other was last planted. `planted` (batch, 1 + frames, 2)
    begins before the window; `before` (0 or 1, joints, 3) is the frame there."""
    weight, errors = 1.0 / (sigma * sigma), np.empty(joints.shape[1])
    for b in range(len(joints)):
        errors[:] = 0.0
        visit_touch_downs(joints, before, planted, toes, length, b, errors, 0.0, d_joints)
        visit_touch_downs(joints, before, planted, toes, length, b, errors, weight, d_joints)
        for t in range(joints.shape[1]):
            energy[b, t] = 0.5 * weight * errors[t] * errors[t]


_ARC_LIMIT = 1e9  # metres; beyond it, and for arcs that are no numbers, there is no segment to count


@inner
def find_segment(curve, arc):
    """Find the segment of an arc, counted on through the laps of a closed curve, and the lap's first arc."""
    count, lap = len(curve.directions), 0.0
    if curve.closed:
        lap = math.floor(arc / curve.length)
    within, first, beyond = arc - lap * curve.length, 0, count
    while beyond - first > 1:
        middle = (first + beyond) // 2
        if curve.knots[middle] <= within:
            first = middle
        else:
            beyond = middle
    return np.int64(lap) * count + first


@inner
def evaluate_position(curve, arc, position):
    """Evaluate the position on the curve at an arc: straight on beyond open ends."""
    segment = find_segment(curve, arc)
    lap, index = segment // len(curve.directions), segment % len(curve.directions)
    along = arc - lap * curve.length - curve.knots[index]
    for k in range(len(position)):
        position[k] = curve.corners[index, k] + along * curve.directions[index, k]


@inner
def find_nearest_arc(curve, point, around, reach):
    """Find the arc of the position nearest to a point on the segments within reach of `around`; NaN if the point is."""
    best, found, count = math.inf, math.nan, len(curve.directions)
    for segment in range(find_segment(curve, around - reach), find_segment(curve, around + reach) + 1):
        lap, index = segment // count, segment % count
        along, apart = 0.0, 0.0
        for k in range(len(point)):
            along += (point[k] - curve.corners[index, k]) * curve.directions[index, k]
        if curve.closed or index > 0:  # the pieces beyond open ends have no end
            along = max(along, 0.0)
        if curve.closed or index < count - 1:
            along = min(along, curve.knots[index + 1] - curve.knots[index])
        for k in range(len(point)):
            off = curve.corners[index, k] + along * curve.directions[index, k] - point[k]
            apart += off * off
        if apart < best:
            best, found = apart, lap * curve.length + curve.knots[index] + along
    return found


@inner
def evaluate_axes(curve, arc, ahead, behind, axes):
    """Evaluate rows: left on the ground, forward (a chord's direction), in space upward but for what lies forward.

    `ahead` and `behind` (dims) are scratch.
    """
    last = len(ahead) - 1
    evaluate_position(curve, arc + curve.half_base, ahead)
    evaluate_position(curve, arc - curve.half_base, behind)
    length = 0.0
    for k in range(last + 1):
        ahead[k] -= behind[k]
        length += ahead[k] * ahead[k]
    length = math.sqrt(length)
    if length < 1e-6:  # where a curve turns back on itself the chord vanishes
        segment, length = find_segment(curve, arc) % len(curve.directions), 0.0
        for k in range(last + 1):
            ahead[k] = curve.directions[segment, k]
            length += ahead[k] * ahead[k]
        length = math.sqrt(length)
    for k in range(last + 1):
        ahead[k] /= length
    ground = max(math.sqrt(ahead[0] * ahead[0] + ahead[last] * ahead[last]), 1e-9)
    for k in range(last + 1):
        axes[0, k], axes[1, k] = 0.0, ahead[k]
    axes[0, 0], axes[0, last] = ahead[last] / ground, -ahead[0] / ground
    if last == 2:
        for k in range(3):
            axes[2, k] = -ahead[1] * ahead[k]
        axes[2, 1] += 1.0


@entry
def fill_local_frames(curve, points, around, reach, positions, axes, straightened):
    """Fill local frames of points (batch, frames, dims) near arcs `around` (frames); see `local_frame.LocalFrame`."""
    if curve.closed:
        reach = min(reach, 0.5 * curve.length)  # a lap has every position once
    dims = points.shape[2]
    position, frame, scratch = np.empty(dims), np.empty((dims, dims)), np.empty((2, dims))
    for b in range(len(points)):
        for t in range(len(around)):
            arc = math.nan
            if abs(around[t]) < _ARC_LIMIT:
                arc = find_nearest_arc(curve, points[b, t], around[t], reach)
                arc = arc if math.isfinite(arc) else around[t]
                evaluate_position(curve, arc, position)
                evaluate_axes(curve, arc, scratch[0], scratch[1], frame)
            for k in range(dims):
                known = math.isfinite(arc)
                positions[b, t, k] = position[k] if known else math.nan
                straightened[b, t, k] = position[k] + (around[t] - arc) * frame[1, k] if known else math.nan
                for row in range(dims):
                    axes[b, t, row, k] = frame[row, k] if known else math.nan


@dataclass(frozen=True, eq=False)
class LocalFrame:
    """The curve near each point; constants, without gradient."""

    position: Float[Tensor, "batch frames dims"]
    """Nearest position on the curve, metres."""
    axes: Float[Tensor, "batch frames dims dims"]
    """Unit rows: left on the ground, forward; in space a third, upward less what of it lies along the slope."""
    tangent_extension: Float[Tensor, "batch frames dims"]
    """Position of the arc looked around if the curve went straight on from the nearest one, metres."""


class _CurveTables(NamedTuple):
    knots: np.ndarray
    corners: np.ndarray
    directions: np.ndarray
    closed: bool
    length: float
    half_base: float


def find_local_frames(
    curve: Curve, points: Float[Tensor, "batch frames dims"], around: Float[Tensor, " frames"], *, reach: float
) -> LocalFrame:
    """Find the nearest positions within `reach` metres of the arcs `around`; results have the points' dtype.

    Points have the curve's dimensions. Arcs that are not finite give NaN.
    """
    arcs = around.detach().double().contiguous().numpy()
    known = points.detach().contiguous()
    near = LocalFrame(torch.empty_like(known), known.new_empty(*known.shape, curve.dims), torch.empty_like(known))
    filled = (near.position.numpy(), near.axes.numpy(), near.tangent_extension.numpy())
    fill_local_frames(_build_tables(curve), known.numpy(), arcs, reach, *filled)
    return near


def _build_tables(curve: Curve) -> _CurveTables:
    knots, corners, directions = (table.numpy() for table in curve._tables)
    return _CurveTables(knots, corners, directions, curve.closed, curve.length, curve._half_base)
