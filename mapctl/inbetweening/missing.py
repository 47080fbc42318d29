"""Missing values of a motion on any rig, and their interpolation: by cubics that leave and arrive at the velocities
beside a gap, as far as velocities last that long."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from mapctl import rotations
from mapctl.features import PRIOR_FPS
from mapctl.motion import Motion
from mapctl.numerics.intervals import fill_missing, last_observed, next_observed
from mapctl.numerics.smooth_offsets import blend_seams_in_positions, blend_seams_in_rotations
from mapctl.recording.masks import MissingMask

_VELOCITY_SECONDS = 0.6  # seconds over which half of a velocity is lost


def interpolate_missing(motion: Motion, missing: MissingMask) -> Motion:
    """Interpolate missing values from the nearest known frames on both sides: by slerp and straight lines, bent by
    the velocities beside the gap; beyond the first and the last known frame they hold, and joints that are never known
    rest."""
    known, fps = ~missing.joints.T, float(motion.fps)
    before, after = last_observed(known).T, next_observed(known).T
    quats = motion.local_quat_xyzw
    frame, joint = missing.joints.nonzero(as_tuple=True)
    gap = _Gaps(frame, before[frame, joint], after[frame, joint], motion.num_frames)

    def turn(first: Int[Tensor, " values"], last: Int[Tensor, " values"]) -> Float[Tensor, "values 3"]:
        return rotations.turns_between(quats[first, joint], quats[last, joint])

    between = rotations.slerp(quats[gap.before, joint], quats[gap.after, joint], gap.share.to(quats))
    bend = rotations.from_rotation_vector(_carry_velocities(gap, turn, lambda at: known[joint, at], fps=fps))
    between = rotations.multiply(between, bend)
    rest = quats.new_tensor([0.0, 0.0, 0.0, 1.0])
    between = torch.where(known.any(dim=1)[joint, None], between, rest)
    moving = {number: _interpolate_root(values, missing.root, fps) for number, values in motion.moving_offsets.items()}
    return replace(
        motion,
        local_quat_xyzw=quats.index_put((frame, joint), between),
        root_position=_interpolate_root(motion.root_position, missing.root, fps),
        moving_offsets=moving,
    )


def blend_seams(motion: Motion, missing: MissingMask) -> Motion:
    """Blend the seams of values that were missing and are filled in; all others stay."""
    fps = float(motion.fps)
    blend = partial(blend_seams_in_positions, new=missing.root, fps=fps)
    return replace(
        motion,
        root_position=blend(motion.root_position),
        moving_offsets={joint: blend(values) for joint, values in motion.moving_offsets.items()},
        local_quat_xyzw=blend_seams_in_rotations(motion.local_quat_xyzw, missing.joints, fps=fps),
    )


@dataclass(frozen=True, eq=False)
class _Gaps:
    """Missing values one by one, with the known frames around each."""

    frame: Int[Tensor, " values"]
    before: Int[Tensor, " values"]
    after: Int[Tensor, " values"]
    frames: int

    @property
    def length(self) -> Float[Tensor, " values"]:
        """Frames from the known one before to the one after."""
        return (self.after - self.before).clamp_min(1).double()

    @property
    def share(self) -> Float[Tensor, " values"]:
        """Share of the gap that has passed."""
        return ((self.frame - self.before) / self.length).clamp(0, 1)


def _carry_velocities(
    gap: _Gaps,
    displacement: Callable[[Tensor, Tensor], Float[Tensor, "values width"]],
    is_known: Callable[[Tensor], Bool[Tensor, " values"]],
    *,
    fps: float,
) -> Float[Tensor, "values width"]:
    """Compute what a cubic Hermite spline adds to straight lines: the velocities of the 1/30 s beside a gap, where they
    are known on one side with no acceleration at the other end; as far as they last."""
    length, share, steps = gap.length[:, None], gap.share[:, None], max(1, round(fps / float(PRIOR_FPS)))
    straight = displacement(gap.before, gap.after) / length
    enclosed = (gap.before < gap.frame) & (gap.frame < gap.after)
    excess, there = [], []
    for side, step in ((gap.before, -steps), (gap.after, steps)):
        beside = (side + step).clamp(min=0)
        inside = enclosed & (side + step >= 0) & (side + step < gap.frames)
        beside = torch.where(inside, beside, side)
        known = inside & is_known(beside) & is_known((side + beside) // 2)
        first, last = (beside, side) if step < 0 else (side, beside)
        excess.append(torch.where(known[:, None], displacement(first, last) / steps - straight, 0.0))
        there.append(known[:, None])
    (leaving, arriving), (left, right) = excess, there
    rest = 1 - share
    bend = leaving * share * torch.where(right, rest**2, rest * (1 + rest) / 2)
    bend = bend - arriving * rest * torch.where(left, share**2, share * (1 + share) / 2)
    return bend * length * compute_velocity_share(length, fps=fps)


def compute_velocity_share(length: Float[Tensor, "*values"] | float, *, fps: float) -> Float[Tensor, "*values"] | float:
    """Compute how far the velocity before a gap of so many frames lasts: 1 / (1 + (seconds / 0.6)^2).

    The regression of captured motion on the spline through it, over unseen clips of walks, gestures, dances and fights,
    is 0.97 over 5 frames at 30 fps, 0.65 over 15 and 0.1 to 0.5 over 30.
    """
    return 1 / (1 + (length / (_VELOCITY_SECONDS * fps)) ** 2)


def _interpolate_root(
    values: Float[Tensor, "frames 3"], missing: Bool[Tensor, " frames"], fps: float
) -> Float[Tensor, "frames 3"]:
    known, frame = ~missing[None], missing.nonzero()[:, 0]
    gap = _Gaps(frame, last_observed(known)[0, frame], next_observed(known)[0, frame], len(values))
    bend = _carry_velocities(gap, lambda first, last: values[last] - values[first], lambda at: known[0, at], fps=fps)
    filled = fill_missing(values[None], known)[0]
    return values.index_put((frame,), filled[frame] + bend.to(values))
