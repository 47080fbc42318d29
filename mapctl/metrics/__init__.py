"""Measures of a motion; names carry their units.

A measure that a clip cannot give (sway of one second, contact speed without a contact) is NaN.
"""

import math
from collections.abc import Iterable
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from mapctl import retarget
from mapctl.curves.curve import Curve
from mapctl.curves.tracking import track_arcs
from mapctl.errors import RequestError
from mapctl.features import PRIOR_FPS
from mapctl.joint_roles import find_feet, find_hips, find_upper_legs
from mapctl.metrics import body, feet
from mapctl.motion import Motion
from mapctl.numerics import gaussian
from mapctl.retarget import UNKNOWN_RIG_NOTE
from mapctl.retarget.rigs import Rig
from mapctl.skeleton import CANONICAL

LOW_PASS_SECONDS = 0.5
"""Standard deviation of the Gaussian that takes natural sway out of the path error."""
SWAY_SECONDS = 0.35
"""Standard deviation of the Gaussian whose slow part is not sway."""


def sway(offset: Float[Tensor, "frames"], fps: float) -> float:
    """Return the root mean square of a sideways offset without its slow part; NaN for clips too short (2.2 s)."""
    reach = int(3 * SWAY_SECONDS * fps)
    if len(offset) <= 2 * reach + 4:
        return math.nan
    # Inside, where the whole kernel lies on the walk.
    quick = (offset - gaussian.smooth(offset, SWAY_SECONDS * fps, side=reach))[reach:-reach]
    return float(quick.square().mean().sqrt())


_CM = 100.0
_HEELS = "heel_contact_speed_cm_s", "heel_planted_share", "heel_slide_max_cm", "foot_turn_deg_s"


def measure(motion: Motion, curve: Curve | None = None, *, speed: float | None = None) -> dict[str, float]:
    """Measure one motion, by name of the measure.

    Always: `skate_cm_s`, `skate_ratio`, `contact_speed_cm_s`, `planted_share`, `penetration_cm`, `float_cm`,
    `heel_contact_speed_cm_s`, `heel_planted_share`, `heel_slide_max_cm` and `foot_turn_deg_s` (canonical joints alone
    show where heels are, else NaN), the worst frames `glide_cm`, `slide_max_cm`, `unsupported_max_s`, `depth_max_cm`
    and `acceleration_max_m_s2` (see `body.measure_worst`), `jitter_m_s3`, `speed_m_s`, `turned_deg`,
    `turn_rate_deg_s`, `hips_height_m`, `pose_variation_cm`, and `sway_cm`: from the straight line between the walk's
    ends, or from the curve. With a curve
    also `path_error_{mean,p95,max}_cm`, `path_error_low_passed_{mean,p95,max}_cm` and `travelled_m`; with the wanted
    `speed` (m/s) `wanted_m` and `progress_ratio` too; the hips follow it. MapctlError for rigs whose hips, legs or feet
    are not found, and motions of one frame.
    """
    if motion.num_frames < 2:
        raise RequestError("measures need a motion of at least 2 frames")
    positions, fps, hips = motion.joint_positions(), float(motion.fps), find_hips(motion.skeleton)
    toes = list(find_feet(motion.skeleton))
    measures = _measure_feet(positions[:, toes], fps)
    if motion.skeleton.names == CANONICAL.names:  # other rigs do not show where heels are
        measures |= feet.measure_heels(motion)
    else:
        measures |= dict.fromkeys(_HEELS, math.nan)
    measures |= body.measure_worst(positions, hips, toes, [motion.skeleton.parents[toe] for toe in toes], fps)
    measures |= _measure_body(positions, hips, find_upper_legs(motion.skeleton), fps)
    if curve is None:
        # Distances of the walk from the line piece between its ends; left is positive.
        ground = positions[:, hips, ::2]
        along, apart = ground[-1] - ground[0], ground - ground[0]
        share = ((apart @ along) / along.square().sum().clamp_min(1e-12)).clamp(0, 1)
        side = torch.sign(along[1] * apart[:, 0] - along[0] * apart[:, 1])
        return measures | {"sway_cm": sway((apart - share[:, None] * along).norm(dim=-1) * side, fps) * _CM}
    return measures | _measure_path(positions[:, hips], curve, speed, fps)


def _measure_feet(toe_positions: Float[Tensor, "frames 2 3"], fps: float) -> dict[str, float]:
    toes = feet.ToeMeasurements.of(toe_positions, fps)
    return {
        "skate_cm_s": feet.skate(toes) * _CM,
        "skate_ratio": feet.skate_ratio(toes),
        "contact_speed_cm_s": feet.contact_speed(toes) * _CM,
        "planted_share": feet.planted_share(toes),
        "penetration_cm": feet.penetration(toes) * _CM,
        "float_cm": feet.float_height(toes) * _CM,
    }


def _measure_body(positions: Tensor, hips: int, upper_legs: tuple[int, int], fps: float) -> dict[str, float]:
    left, right = upper_legs
    angle = body.facing(positions[:, left], positions[:, right])
    return {
        "jitter_m_s3": body.jitter(positions, fps),
        "speed_m_s": body.ground_speed(positions[:, hips], fps),
        "turned_deg": float(torch.rad2deg(angle.max() - angle.min())),
        "turn_rate_deg_s": float(torch.rad2deg(torch.tensor(body.turn_rate(angle, fps)))),
        "hips_height_m": float(positions[:, hips, 1].mean()),
        "pose_variation_cm": body.pose_variation(positions, positions[:, hips], angle) * _CM,
    }


def _measure_path(
    positions: Float[Tensor, "frames 3"], curve: Curve, speed: float | None, fps: float
) -> dict[str, float]:
    arcs = track_arcs(curve, positions)
    travelled = float(arcs[-1] - arcs[0])
    # To the curve at the walk's arc, between the curve's ends, without height for a ground curve: the nearest point of
    # all may belong to another branch. The offset is smoothed and not the walk, which would shrink on every bend.
    on_it = curve.point(arcs if curve.closed else arcs.clamp(0, curve.length))
    apart = on_it - (positions[:, ::2] if positions.shape[1] > curve.dims else positions)
    offset = curve.signed_offset(positions, arcs)
    slow = gaussian.average(offset, seconds=LOW_PASS_SECONDS, fps=fps).abs()
    measures = _summarise_errors("path_error_{}_cm", apart.norm(dim=-1))
    measures |= _summarise_errors("path_error_low_passed_{}_cm", slow)
    measures |= {"sway_cm": sway(offset, fps) * _CM, "travelled_m": travelled}
    if speed is not None:
        wanted = speed * (len(positions) - 1) / fps
        measures |= {"wanted_m": wanted, "progress_ratio": travelled / wanted if wanted else float("nan")}
    return measures


def _summarise_errors(name: str, error: Float[Tensor, "frames"]) -> dict[str, float]:
    values = {"mean": error.mean(), "p95": error.quantile(0.95), "max": error.max()}
    return {name.format(kind): float(value) * _CM for kind, value in values.items()}


class MeasureStatistics(NamedTuple):
    """Spread of one measure over a set of clips."""

    mean: float
    """Mean over the clips, in the measure's unit."""
    p2: float
    """2nd percentile, in the same unit."""
    p98: float
    """98th percentile, in the same unit."""


def compute_reference(motions: Iterable[Motion]) -> dict[str, MeasureStatistics]:
    """Compute mean, 2nd and 98th percentile of every measure over clips, to print beside ours.

    NaN is left out: clips that cannot give a measure. RequestError for no clips at all.
    """
    rows = [measure(motion) for motion in motions]
    if not rows:
        raise RequestError("a reference needs at least one clip")
    table = {name: torch.tensor([row[name] for row in rows], dtype=torch.float64) for name in rows[0]}
    ends = torch.tensor([0.02, 0.98], dtype=torch.float64)
    return {
        name: MeasureStatistics(float(values.nanmean()), *values.nanquantile(ends).tolist())
        for name, values in table.items()
    }


_RATE_TOLERANCE = 0.02  # share of the reference's rate within which measures are the same, as of 29.97 frames a second


def make_comparable(motion: Motion, rig: Rig | None = None) -> tuple[Motion, tuple[str, ...]]:
    """Convert a motion to what reference values of mocap were measured on: canonical joints, Y up, 30 frames a second.

    Frames are left out of faster motions; slower ones stay, since nothing is known between their frames. Sentences tell
    what could not be converted: a rig that is not known stays as it is in the file. `rig` wins over what would be
    recognised.
    """
    notes: tuple[str, ...] = ()
    try:
        motion = retarget.to_canonical(motion, rig)[0]
    except RequestError:
        notes = (UNKNOWN_RIG_NOTE,)
    if motion.fps > PRIOR_FPS * (1 + _RATE_TOLERANCE):
        motion = motion.resample(PRIOR_FPS)
    if motion.fps < PRIOR_FPS * (1 - _RATE_TOLERANCE):
        rate = f"{float(motion.fps):.4g} frames a second"
        notes = (*notes, f"measured at {rate}; mocap's values at {PRIOR_FPS} tell of quicker changes")
    return motion, notes
