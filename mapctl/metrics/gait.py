"""Paces, and changes of pace: starts, stops, and changes between a walk and a run, by the hips' smoothed speed."""

from collections.abc import Sequence
from dataclasses import astuple, dataclass
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from numpy import ndarray
from scipy.ndimage import gaussian_filter1d
from torch import Tensor

from mapctl import contacts
from mapctl.errors import RequestError
from mapctl.joint_roles import find_feet, find_hips
from mapctl.metrics import body
from mapctl.motion import Motion
from mapctl.numerics.gaussian import low_pass
from mapctl.rotations import unwrap_angle

_SMOOTH_SECONDS = 0.2  # standard deviation of a Gaussian over which sway within a stride is averaged out
STANDS, GOES = 0.2, 0.6
"""Speeds between which a start or a stop leads, m/s."""
WALKS, RUNS = 1.7, 2.1
"""Speeds between which a change of gait leads, m/s."""

PACES = "stand", "walk", "run"
"""Paces from slow to fast; who goes and does not run walks."""
CHANGES = {
    ("stand", "walk"): "starts",
    ("walk", "stand"): "stops",
    ("walk", "run"): "changes to a run",
    ("run", "walk"): "changes to a walk",
}
"""Names of the changes from one pace to the next, by both, in the order of the fields of PaceChanges."""


@dataclass(frozen=True)
class PaceChanges:
    """How often the pace of one motion changes."""

    starts: int = 0
    """From under 0.2 to over 0.6 m/s."""
    stops: int = 0
    """From over 0.6 to under 0.2 m/s."""
    to_run: int = 0
    """From under 1.7 to over 2.1 m/s."""
    to_walk: int = 0
    """From over 2.1 to under 1.7 m/s."""

    def __add__(self, other: "PaceChanges") -> "PaceChanges":
        return PaceChanges(*(one + another for one, another in zip(astuple(self), astuple(other), strict=True)))

    def by_name(self) -> dict[str, int]:
        """Return how often each of CHANGES happens, by its name."""
        return dict(zip(CHANGES.values(), astuple(self), strict=True))


def label_pace(pace: str) -> str:
    """Return the label of a pace, `pace=walk`, for a density that is conditioned on it."""
    return f"pace={pace}"


def compute_ground_velocity(ground: Float[ndarray, "frames 2"], fps: float) -> Float[ndarray, "frames 2"]:
    """Compute the velocity of the hips over the ground, m/s, from their x and z in metres, without the sway within a
    stride; of at least two frames."""
    # Velocities are smoothed rather than places: who runs at a clip's end does not stay there.
    velocity = np.gradient(ground, 1 / fps, axis=0)
    return gaussian_filter1d(velocity, _SMOOTH_SECONDS * fps, axis=0, mode="nearest")


def measure_speed(ground: Float[ndarray, "frames 2"], fps: float) -> Float[ndarray, " frames"]:
    """Measure the speed of the hips over the ground, m/s, from their x and z in metres, without the sway within a
    stride; 0 for a single frame."""
    return np.linalg.norm(compute_ground_velocity(ground, fps), axis=1) if len(ground) > 1 else np.zeros(len(ground))


def count_pace_changes(speed: Float[ndarray, " frames"]) -> PaceChanges:
    """Count the changes along a motion's smoothed speed, m/s. Who hesitates without passing both bounds changes
    nothing."""
    goes, runs = (_follow(speed, *bounds) for bounds in ((STANDS, GOES), (WALKS, RUNS)))
    return PaceChanges(_count_rises(goes), _count_rises(~goes), _count_rises(runs), _count_rises(~runs))


def follow_pace(speed: Float[ndarray, " frames"]) -> Int[ndarray, " frames"]:
    """Follow the pace along a motion's smoothed speed, m/s: the index in PACES of each frame.

    A pace lasts until the other bound of a change is passed, so that `count_pace_changes` counts the changes of it;
    before the first bound that is passed, it is the one that this bound tells.
    """
    goes, runs = (_follow(speed, *bounds) for bounds in ((STANDS, GOES), (WALKS, RUNS)))
    return np.where(runs, 2, goes.astype(int))


def find_pace(speed: float) -> str:
    """Find the pace of a mean speed, m/s, halfway between the bounds of changes."""
    return PACES[(speed > (STANDS + GOES) / 2) + (speed > (WALKS + RUNS) / 2)]


def _follow(speed: Float[ndarray, " frames"], low: float, high: float) -> Bool[ndarray, " frames"]:
    """Whether it was over `high` since it was last under `low`. Before either, the first of them tells; between both
    all along, the mean."""
    passed = np.flatnonzero((speed < low) | (speed > high))
    if len(passed) == 0:
        return np.full(len(speed), len(speed) > 0 and float(np.mean(speed)) > (low + high) / 2)
    last = np.searchsorted(passed, np.arange(len(speed)), side="right") - 1
    return (speed > high)[passed[np.maximum(last, 0)]]


def _count_rises(fast: Bool[ndarray, " frames"]) -> int:
    return int(np.count_nonzero(~fast[:-1] & fast[1:]))


PIECE_SECONDS = 3.0
"""Length of the pieces: long averages vary less than short ones, so sets are compared in pieces of one length."""
LONGEST_STEP = 1.0
"""Longest step, seconds; touch-downs further apart have a contact between them that was not detected."""
_MOVING = 0.2
"""Speed over the ground, m/s, below which the direction of travel is not measured."""


class GaitSpread(NamedTuple):
    """Statistics of one measure over the pieces of a set of clips; NaN where too few of them have it."""

    mean: float
    """Mean over pieces."""
    std: float
    """Standard deviation over pieces."""
    pieces: int
    """Number of pieces that have the measure."""


def measure_gait_spread(motions: Sequence[Motion], *, seconds: float = PIECE_SECONDS) -> dict[str, GaitSpread]:
    """Measure the spread of step_length_cm, speed_m_s and turning_deg_s over consecutive pieces of the clips (any rig).

    Step length is the mean of a piece's distances over the ground from one foot's touch-down to the next of the other
    foot; speed the hips' mean over the ground; turning the mean size of the turn rate of their travel, strides smoothed
    away. What is left of a clip after its last whole piece is not used, so clips shorter than `seconds` add nothing.
    RequestError for no clips, a length that is none, and rigs whose hips or feet are not found.
    """
    if not motions or not 0 < seconds < float("inf"):
        raise RequestError(f"a gait needs clips and a length in seconds, got {len(motions)} and {seconds:g} s")
    pieces = [_measure_clip_gait(motion, seconds) for motion in motions]
    return {name: _summarise_pieces(torch.cat([clip[name] for clip in pieces])) for name in pieces[0]}


def _summarise_pieces(values: Float[Tensor, "pieces"]) -> GaitSpread:
    known = values[~values.isnan()]
    if len(known) < 2:
        return GaitSpread(float(values.nanmean()), float("nan"), len(known))
    return GaitSpread(float(known.mean()), float(known.std()), len(known))


def _measure_clip_gait(motion: Motion, seconds: float) -> dict[str, Float[Tensor, "pieces"]]:
    """Measure a value for each whole piece of a clip, by measure. Contacts and smoothing know the whole clip."""
    positions, fps = motion.joint_positions(), float(motion.fps)
    hips = positions[:, find_hips(motion.skeleton)]
    toes = positions[:, list(find_feet(motion.skeleton))]
    frames = max(2, round(seconds * fps))
    count = len(positions) // frames
    by_frame = {
        "step_length_cm": 100 * step_lengths(toes[..., ::2], contacts.detect_contacts(toes, fps), fps),
        "turning_deg_s": torch.rad2deg(travel_turn_rate(hips[:, ::2], fps)),
    }
    speeds = [body.ground_speed(piece, fps) for piece in hips[: count * frames].split(frames)] if count else []
    means = {name: values[: count * frames].reshape(count, frames).nanmean(1) for name, values in by_frame.items()}
    return {
        "step_length_cm": means["step_length_cm"],
        "speed_m_s": hips.new_tensor(speeds),
        "turning_deg_s": means["turning_deg_s"],
    }


def step_lengths(
    toes_xz: Float[Tensor, "frames feet 2"], planted: Bool[Tensor, "frames feet"], fps: float
) -> Float[Tensor, "frames"]:
    """Return the length of the step that a touch-down ends in its frame, metres; NaN where none does.

    A touch-down is the first frame of a contact. Two in a row of one foot make no step, nor do two that are
    `LONGEST_STEP` apart.
    """
    lengths = torch.full((len(planted),), float("nan"), dtype=toes_xz.dtype)
    downs = ((planted[1:] & ~planted[:-1]).nonzero() + planted.new_tensor([1, 0], dtype=torch.long)).tolist()
    for (before, other), (frame, foot) in pairwise(downs):
        if foot != other and frame - before < LONGEST_STEP * fps:
            lengths[frame] = (toes_xz[frame, foot] - toes_xz[before, other]).norm()
    return lengths


def travel_turn_rate(hips_xz: Float[Tensor, "frames 2"], fps: float) -> Float[Tensor, "frames"]:
    """Return the size of the turn rate of the direction of travel, rad/s; NaN where the hips hardly move.

    Smoothed as `body.turn_rate`, so that the hips' swing with each stride does not count.
    """
    rate = torch.full((len(hips_xz),), float("nan"), dtype=hips_xz.dtype)
    if len(hips_xz) < 3:
        return rate
    velocity = hips_xz.diff(dim=0) * fps
    slow = torch.stack([low_pass(axis, seconds=body.TURN_SECONDS, fps=fps) for axis in velocity.T], dim=-1)
    moving = slow.norm(dim=-1) > _MOVING
    turn = unwrap_angle(torch.atan2(slow[:, 0], slow[:, 1])).diff().abs() * fps
    rate[2:] = torch.where(moving[1:] & moving[:-1], turn, float("nan"))
    return rate
