"""Correct the trajectory of a capture from video: the pose is right, but the hips drift and float about it.

A MAP problem, linear once it is known which toes stand, solved in turn with that (iteratively reweighted least squares,
Holland and Welsch 1977).
"""

import math
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float
from numpy import ndarray
from scipy import ndimage, sparse, special

from mapctl import rotations
from mapctl.contacts import REST_SPEED, TOE_LEVEL, compute_rest_log_probability
from mapctl.ground import Ground
from mapctl.motion import Motion
from mapctl.skeleton import CANONICAL, TOE_REST_HEIGHT, TOES, leg_length

_CAPTURED_DRIFT, _STANCE_SECONDS = 0.09, 1.5  # m/s below which captured hips drift, and stance that shows it
_LEVEL_RANGE = 0.5  # metres by which the floor of an estimate from video drifts: a climber's has more
_CORRELATION_SECONDS = 0.2  # time over which the drift's velocity is correlated
_EVEN_SECONDS = 0.06  # the drift's velocity over its acceleration: less leaves kinks where toes land and leave
_LEAST_DRIFT = 0.01  # m/s
_SINK_SPEED, _SINK_HEIGHT = 0.1, 0.5  # m/s by which, and metres to which, heights drift
_REST_RANGE = 0.06  # metres by which toes of other rigs rest higher or lower
_SWING_HEIGHT = 0.3  # metres over the floor within which a toe swings
_FLOOR_SECONDS, _FLOOR_PERCENTILE = 1.2, 15  # of the lower toe's height: the floor of the first solve
_VELOCITY_ERRORS = (0.3, 0.2, 0.12, 0.08, 0.05, 0.05)
"""Error of the hips' velocity, m/s, before each solve: what is unsure at first decides late (graduated non-convexity,
Blake and Zisserman 1987)."""


@dataclass(frozen=True, eq=False)
class CorrectedTrajectory:
    """A motion whose standing toes neither slide nor leave the floor."""

    motion: Motion
    drift: float
    """Standard deviation of the velocity, m/s, at which standing toes slid."""
    from_video: bool
    """Whether toes stand for long enough, on about one level, and slide faster than captured ones do, but not steadily
    in the body's own frame as under a walk in place, or where feet land and leave fast."""


def correct_trajectory(motion: Motion, explained: float = 0.0, ground: Ground | None = None) -> CorrectedTrajectory:
    """Find the hips under which the standing toes of a canonical motion are still, on the floor at y = 0 or on the
    `ground`; `explained` is the drift, m/s, that errors of its pose alone would show.

    Coordinates x of the hips minimise the sum over frames of w (dx + df)^2 / s_rest^2 + (dx - do)^2 / s^2 + (x - o)^2 /
    s_0^2, with captured hips o, toes f about the hips, and weights w, the probability that a toe stands: slow, below
    the hips and low. The drift s is estimated from the velocity of standing toes (empirical Bayes), so that hips over
    toes that are still stay; s_0 is s over its time of correlation, and the drift x - o has an acceleration in
    proportion. Heights have w (x + f - r)^2 / s_level^2 in addition, r the height at which toes rest,
    over the ground that was under them in the solve before. In the end standing toes are as high as the median of what
    was captured, where rigs' toes rest about so high.
    """
    if motion.num_frames < 3:
        return CorrectedTrajectory(motion, 0.0, from_video=False)
    fps, hips = float(motion.fps), motion.root_position.numpy()
    toes = motion.joint_positions()[:, motion.skeleton.indices(TOES)].numpy()
    about = toes - hips[:, None]
    lower = (toes[..., 1] - _find_levels(toes, ground)).min(axis=1)
    usual = rest = TOE_REST_HEIGHT * leg_length(motion.skeleton) / leg_length(CANONICAL)
    window = 2 * round(_FLOOR_SECONDS * fps / 2) + 1
    floor = ndimage.percentile_filter(lower, _FLOOR_PERCENTILE, window, mode="nearest")
    if abs(np.median(floor) - rest) < _REST_RANGE:
        rest = float(np.median(floor))
    found = hips + np.outer(rest - floor, (0, 1, 0))
    captured = hips + np.array([0, rest - np.median(floor), 0])
    heading = rotations.split_heading(motion.local_quat_xyzw[1:, 0])[0]
    slide = rotations.rotate_ground(fps * torch.from_numpy(toes[..., [0, 2]]).diff(dim=0), -heading[:, None]).numpy()
    drift, stands, standing = 0.0, np.zeros(slide.shape[:2]), np.zeros(toes.shape[:2])
    for error in _VELOCITY_ERRORS:
        rests = rest + _find_levels(about + found[:, None], ground)
        standing = _weigh_standing(about, found, rests, fps, error)
        stands = np.minimum(standing[1:], standing[:-1])
        # Of two normal coordinates the speed's median is sqrt(ln 4) of their standard deviation (Rayleigh).
        drift = _weighted_median(np.linalg.norm(slide, axis=-1), stands) / math.sqrt(math.log(4))
        drift = max(_LEAST_DRIFT, math.sqrt(max(0.0, drift**2 - REST_SPEED**2)))
        prior = (drift, _CORRELATION_SECONDS * drift)
        across = _solve(captured[:, [0, 2]], about[..., [0, 2]], stands, fps, prior)
        levels = standing / TOE_LEVEL**2, rests[..., None] - about[..., 1:2]
        height = _solve(captured[:, 1:2], about[..., 1:2], stands, fps, (_SINK_SPEED, _SINK_HEIGHT), levels)
        found = np.stack([across[:, 0], height[:, 0], across[:, 1]], axis=1)
    own = _weighted_median(toes[..., 1] - _find_levels(toes, ground), standing)
    if abs(own - usual) < _REST_RANGE:
        found[:, 1] += own - rest
    steady = np.linalg.norm((stands[..., None] * slide).sum(axis=(0, 1))) / max(float(stands.sum()), 1e-9)
    shows = stands.max(axis=1).sum() > _STANCE_SECONDS * fps and np.ptp(floor) < _LEVEL_RANGE
    corrected = replace(motion, root_position=torch.from_numpy(found).to(motion.root_position))
    return CorrectedTrajectory(
        corrected, drift, bool(shows and drift > math.hypot(_CAPTURED_DRIFT, explained) and steady < drift / 2)
    )


def _find_levels(toes: Float[ndarray, "frames 2 3"], ground: Ground | None) -> Float[ndarray, "frames 2"]:
    """Find the heights of what is under toes, metres."""
    if ground is None:
        return np.zeros(toes.shape[:2])
    return ground.height(torch.from_numpy(toes[..., [0, 2]])).numpy()


def _weigh_standing(
    about: Float[ndarray, "frames 2 3"],
    hips: Float[ndarray, "frames 3"],
    rests: Float[ndarray, "frames 2"],
    fps: float,
    error: float,
) -> Float[ndarray, "frames 2"]:
    """Weigh toes by the probability that they stand: at rest under the hips, and at the heights at which they rest."""
    toes = torch.from_numpy(about + hips[:, None])
    speed_noise = torch.full((1, 1), error, dtype=toes.dtype)
    resting = compute_rest_log_probability(toes, torch.from_numpy(hips), fps, speed_noise).exp().numpy()
    above = (toes[..., 1].numpy() - rests) / TOE_LEVEL
    return resting * special.expit(math.log(_SWING_HEIGHT / (TOE_LEVEL * math.sqrt(2 * math.pi))) - 0.5 * above**2)


def _solve(
    captured: Float[ndarray, "frames axes"],
    about: Float[ndarray, "frames 2 axes"],
    stands: Float[ndarray, "steps 2"],
    fps: float,
    prior: tuple[float, float],
    levels: tuple[Float[ndarray, "frames 2"], Float[ndarray, "frames 2 axes"]] | None = None,
) -> Float[ndarray, "frames axes"]:
    """Solve the sparse system of coordinates of the hips; `prior` is the standard deviation of the drift's velocity,
    m/s, and of its size, metres, `levels` weights and values of coordinates of the hips that toes show."""
    frames, (speed, size) = len(captured), prior
    step = _build_differences(frames - 1)
    bend = _build_differences(frames - 2) @ step
    still = stands * (fps / REST_SPEED) ** 2
    weights, right = np.full(frames, 1 / size**2), np.zeros_like(captured)
    if levels is not None:
        weights += levels[0].sum(axis=1)
        right += (levels[0][..., None] * (levels[1] - captured[:, None])).sum(axis=1)
    right -= step.T @ (still[..., None] * np.diff(captured[:, None] + about, axis=0)).sum(axis=1)
    smooth = step.T @ sparse.diags_array(still.sum(axis=1) + (fps / speed) ** 2) @ step
    even = np.full(frames - 2, (_EVEN_SECONDS * fps**2 / speed) ** 2)
    system = smooth + bend.T @ sparse.diags_array(even) @ bend + sparse.diags_array(weights)
    drift = sparse.linalg.spsolve(sparse.csc_array(system), right)
    return captured + drift.reshape(captured.shape)


def _build_differences(rows: int) -> sparse.csr_array:
    return sparse.csr_array(sparse.eye_array(rows, rows + 1, k=1) - sparse.eye_array(rows, rows + 1))


def _weighted_median(values: Float[ndarray, "steps 2"], weights: Float[ndarray, "steps 2"]) -> float:
    order = values.argsort(axis=None)
    total = weights.ravel()[order].cumsum()
    return float(values.ravel()[order][min(len(total) - 1, total.searchsorted(total[-1] / 2))])
