"""Infeasible requests, named with numbers: by the data's limits, and by the path error of what was solved."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mapctl.curves import Curve
from mapctl.curves.tracking import track_arcs
from mapctl.features import PRIOR_FPS
from mapctl.intent.path import PathRequest
from mapctl.motion import Motion
from mapctl.protocols import DataLimits

_PATH_TOLERANCE_CM = 15.0
_OVERSHOOT = 0.15  # metres: the last frame of a walk may lie one frame's step beyond the end
_CORNER_SECONDS = 1.0


def check_path(request: PathRequest, arcs: Float[Tensor, " frames"], limits: DataLimits) -> list[str]:
    """Note speeds and corners beyond the prior's data, and a curve that ends too soon."""
    notes = []
    speeds = torch.diff(arcs) * PRIOR_FPS
    fastest, slowest = round(float(speeds.max()), 3), round(float(speeds.min()), 3)
    if fastest > limits.fastest:
        notes.append(f"{fastest:.2f} m/s is faster than the prior's data, which reach {limits.fastest:.2f} m/s")
    if slowest < limits.slowest:
        notes.append(f"{slowest:.2f} m/s is slower than the prior's data, which begin at {limits.slowest:.2f} m/s")
    notes += _check_corners(request, arcs, limits)
    if not request.curve.closed and float(arcs[-1]) > request.curve.length + _OVERSHOOT:
        over = float(arcs[-1]) - request.curve.length
        notes.append(
            f"the last {over:.1f} m go straight on beyond the end of the curve of {request.curve.length:.1f} m"
        )
    return notes


def check_tracking(motion: Motion, curve: Curve, joint: str) -> list[str]:
    """Note the interval around the worst frame in which the path error exceeds 15 cm, if there is one."""
    walked = motion.joint_positions()[:, motion.skeleton.index(joint)]
    positions = walked[:, ::2] if curve.dims == 2 else walked
    error = (positions - curve.point(track_arcs(curve, walked, start=0.0))).norm(dim=-1)
    if float(error.max()) * 100 <= _PATH_TOLERANCE_CM:
        return []
    interval = _find_interval_around(error * 100 > _PATH_TOLERANCE_CM, int(error.argmax()))
    first, last = (float(frame / motion.fps) for frame in interval)
    return [f"the curve is left by up to {100 * float(error.max()):.0f} cm between {first:.1f} and {last:.1f} s"]


def _find_interval_around(off: Bool[Tensor, " frames"], worst: int) -> tuple[int, int]:
    """Find the first and the last frame of the unbroken interval around the worst one."""
    inside = (~off).nonzero()[:, 0]
    before, after = inside[inside < worst], inside[inside > worst]
    return int(before[-1]) + 1 if len(before) else 0, int(after[0]) - 1 if len(after) else len(off) - 1


def _check_corners(request: PathRequest, arcs: Tensor, limits: DataLimits) -> list[str]:
    """Note the sharpest turn over one second of the walk (or all of a shorter one), if it is beyond the data."""
    step = min(round(_CORNER_SECONDS * PRIOR_FPS), len(arcs) - 1)
    samples = request.curve.curvature(arcs) * torch.gradient(arcs)[0]
    turned = torch.nn.functional.pad(samples.cumsum(0), (1, 0))
    turned = (turned[step:] - turned[:-step]).abs()
    worst = int(turned.argmax())
    if float(turned[worst]) <= limits.turn_rate:
        return []
    degrees, able = (torch.rad2deg(torch.tensor(v)).item() for v in (float(turned[worst]), limits.turn_rate))
    return [
        f"the curve turns {degrees:.0f} degrees within a second at {float(arcs[worst]):.1f} m, "
        f"where the prior's data turn at most {able:.0f}"
    ]
