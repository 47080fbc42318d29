"""The cycle of a clip: two frames at which body and velocities are alike, one stride apart where it walks or runs.

Joints are compared from above the hips, in their heading, with their velocities: the distance between two frames is the
root of the mean over joints of |p - q|^2 + (0.1 s |v - w|)^2, which tells frames apart as a motion graph does (Kovar et
al. 2002). The period is the shortest lag at which frames of the moving part of a clip come back to themselves.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mapctl import rotations
from mapctl.editing.footing import find_contacts
from mapctl.errors import RequestError
from mapctl.motion import Motion
from mapctl.skeleton import TOE_JOINTS

SEARCH_FPS = 30
"""Frames a second at which cycles are looked for; what is found is refined at the clip's own."""
_VELOCITY_SECONDS = 0.1  # of velocity that counts as much as position
_SHORTEST_SECONDS, _LONGEST_SECONDS = 0.4, 6.0  # of a cycle
_SHORTEST_FREE_SECONDS = 1.0  # of a cycle of what has no period
_NEAR_PERIOD = 0.2  # share by which a cycle may be longer or shorter than the period
_CLEAR_DIP = 0.75  # of the mean distance, under which a lag is a period
_MOVING_SHARE = 0.3  # of the speed of a clip's fast parts, from which a frame belongs to the moving part
_FAST_QUANTILE = 0.9
_WALKING_SPEED = 0.3  # of the hips, m/s, from which a cycle travels
_KNOWN_SHARE = 0.1  # of pairs with contacts of both feet between them, from which contacts count as detected
_MAX_DISTANCE = 0.1  # metres between two frames that are alike, at most
_MAX_SHARE = 0.5  # of the mean distance between frames, likewise


@dataclass(frozen=True)
class Cycle:
    """Frames that may be repeated: frame `stop` is like frame `start`."""

    start: int
    """First frame."""
    stop: int
    """One past the last frame."""
    distance: float
    """Distance between both frames, metres: pose and velocity."""
    periodic: bool
    """Whether the clip comes back to itself again and again at about this lag."""
    speed: float
    """Mean speed of the hips over the ground, m/s."""

    @property
    def frames(self) -> int:
        """Number of frames."""
        return self.stop - self.start

    @property
    def is_gait(self) -> bool:
        """Whether it is a stride of a walk or a run."""
        return self.periodic and self.speed > _WALKING_SPEED


def find_cycle(motion: Motion) -> Cycle:
    """Find the cycle of a motion on canonical joints (Y up): of a walk or a run one stride, with both feet's contacts.

    RequestError where none is found, which says what comes nearest.
    """
    fps = float(motion.fps)
    step = max(1, round(fps / SEARCH_FPS))
    states = _describe_frames(motion, step)
    lags = _choose_lags(motion, step)
    distances = _measure_lags(states[::step], lags)
    moving = _pair_moving(_find_moving_frames(states[::step]), distances, lags)
    covered = _cover_steps(motion, step, moving, lags)
    limit = min(_MAX_DISTANCE, _MAX_SHARE * float(distances[moving].mean())) if bool(moving.any()) else 0.0
    best = None
    for fits, periodic in _list_searches(distances, moving, lags, fps / step):
        known = int((fits & covered).sum()) > _KNOWN_SHARE * int(fits.sum())
        allowed = fits & covered if known else fits
        if not bool(allowed.any()):
            continue
        lag, start = divmod(int(torch.where(allowed, distances, torch.inf).argmin()), distances.shape[1])
        found = _refine(motion, states, start * step, (start + lags[lag]) * step, step, periodic)
        if found.distance <= limit:
            return found
        best = found if best is None or found.distance < best.distance else best
    raise RequestError(f"no cycle is found: {_describe_failure(best, limit)}")


def _choose_lags(motion: Motion, step: int) -> range:
    """Choose the lengths that a cycle may have, in `step` frames; RequestError for clips that are too short."""
    rate, count = float(motion.fps) / step, -(-motion.num_frames // step)
    lags = range(round(_SHORTEST_SECONDS * rate), min(round(_LONGEST_SECONDS * rate), count - 2) + 1)
    if len(lags) < 3:
        raise RequestError(f"no cycle is found: {motion.seconds:.2f} s are too short for one")
    return lags


def _list_searches(
    distances: Float[Tensor, "lags frames"], moving: Bool[Tensor, "lags frames"], lags: range, rate: float
) -> Iterator[tuple[Bool[Tensor, "lags frames"], bool]]:
    """Yield which pairs may be a cycle, and whether they are a period apart: about each period, the shortest first,
    and at last any a second apart."""
    lag = torch.tensor(list(lags))[:, None]
    for period in _find_periods(distances, moving, lags):
        yield moving & ((lag - period).abs() <= _NEAR_PERIOD * period), True
    yield moving & (lag >= _SHORTEST_FREE_SECONDS * rate), False


def _describe_failure(best: Cycle | None, limit: float) -> str:
    if best is None:
        return "the clip never comes back to where it was in a stride or a second"
    return (
        f"frames {best.start} and {best.stop} come nearest, with joints and velocities {100 * best.distance:.1f} cm"
        f" apart; {100 * limit:.1f} are allowed"
    )


def describe_cycle(motion: Motion, cycle: Cycle) -> dict[str, float | int | bool]:
    """Describe a cycle of a motion on canonical joints, each by a name with its unit."""
    seconds = cycle.frames / float(motion.fps)
    values = {"start": cycle.start, "stop": cycle.stop, "frames": cycle.frames, "seconds": seconds}
    values |= {"mismatch_cm": 100 * cycle.distance, "gait": cycle.is_gait}
    if not cycle.is_gait:
        return values
    hips = motion.root_position
    stride = float((hips[cycle.stop] - hips[cycle.start])[::2].norm())
    return values | {
        "steps_per_minute": 120 / seconds,
        "stride_m": stride,
        "speed_m_s": stride / seconds,
        "right_after_left": _measure_phase(motion, cycle),
        "asymmetry_cm": 100 * _measure_asymmetry(motion, cycle),
    }


def _see_from_hips(motion: Motion) -> Float[Tensor, "frames joints 3"]:
    """Return joint positions from below the hips, turned to face +Z, metres."""
    heading = rotations.split_heading(motion.joint_rotations()[:, 0])[0]
    below = motion.root_position * motion.root_position.new_tensor([1.0, 0.0, 1.0])
    return rotations.rotate_about_y(motion.joint_positions() - below[:, None], -heading[:, None])


def _describe_frames(motion: Motion, step: int) -> Float[Tensor, "frames joints 6"]:
    """Describe each frame by joint positions and velocities (times 0.1 s) over `step` frames on both sides, metres."""
    heading = rotations.split_heading(motion.joint_rotations()[:, 0])[0]
    frames = torch.arange(motion.num_frames)
    before, after = (frames - step).clamp(min=0), (frames + step).clamp(max=motion.num_frames - 1)
    seconds = (after - before).clamp(min=1).double() / float(motion.fps)
    places = motion.joint_positions()
    velocity = (places[after] - places[before]) / seconds[:, None, None]
    velocity = rotations.rotate_about_y(velocity, -heading[:, None])
    return torch.cat([_see_from_hips(motion), _VELOCITY_SECONDS * velocity], dim=-1)


def _measure_lags(states: Float[Tensor, "frames joints 6"], lags: range) -> Float[Tensor, "lags frames"]:
    """Measure the distance of each frame to that so many frames later; infinite where there is none."""
    found = torch.full((len(lags), len(states)), float("inf"), dtype=states.dtype)
    for row, lag in enumerate(lags):
        found[row, : len(states) - lag] = _measure_distance(states[:-lag], states[lag:])
    return found


def _measure_distance(
    one: Float[Tensor, "*batch joints 6"], other: Float[Tensor, "*batch joints 6"]
) -> Float[Tensor, "*batch"]:
    return (one - other).square().sum(dim=-1).mean(dim=-1).sqrt()


def _find_moving_frames(states: Float[Tensor, "frames joints 6"]) -> Bool[Tensor, " frames"]:
    speed = states[..., 3:].square().sum(dim=-1).mean(dim=-1).sqrt()
    return speed >= _MOVING_SHARE * speed.quantile(_FAST_QUANTILE)


def _find_periods(
    distances: Float[Tensor, "lags frames"], moving: Bool[Tensor, "lags frames"], lags: range
) -> list[int]:
    """Find the lags at which moving frames come back, the shortest first: where the mean distance is a local minimum,
    clearly under the mean of all."""
    profile = torch.where(moving, distances, 0.0).sum(dim=1) / moving.sum(dim=1)
    usual = profile.nanmean()
    return [
        lags[row]
        for row in range(1, len(profile) - 1)
        if profile[row] <= profile[row - 1] and profile[row] <= profile[row + 1] and profile[row] < _CLEAR_DIP * usual
    ]


def _pair_moving(
    moving: Bool[Tensor, " frames"], distances: Float[Tensor, "lags frames"], lags: range
) -> Bool[Tensor, "lags frames"]:
    """Return by lag and frame whether both frames are there and move."""
    later = torch.nn.functional.pad(moving, (0, lags[-1])).unfold(0, len(moving), 1)[lags[0] :]
    return moving & later & distances.isfinite()


def _cover_steps(
    motion: Motion, step: int, moving: Bool[Tensor, "lags frames"], lags: range
) -> Bool[Tensor, "lags frames"]:
    """Return which pairs have a contact of each foot and a swing of each between them."""
    positions = motion.joint_positions()
    planted = find_contacts(positions[:, list(TOE_JOINTS)], positions[:, 0], float(motion.fps))[::step]
    counts = torch.nn.functional.pad(planted.long().cumsum(dim=0), (0, 0, 1, 0))
    lag, frames = torch.tensor(list(lags))[:, None], torch.arange(moving.shape[1])
    between = counts[(frames + lag).clamp(max=len(planted))] - counts[frames]
    return ((between > 0) & (between < lag[..., None])).all(dim=-1)


def _refine(motion: Motion, states: Tensor, start: int, stop: int, step: int, periodic: bool) -> Cycle:
    """Choose the two frames around a pair that are most alike, at the clip's own rate."""
    near = range(-step + 1, step)
    starts = [f for f in (start + d for d in near) if f >= 0]
    stops = [f for f in (stop + d for d in near) if f < motion.num_frames]
    distance, start, stop = min(
        (float(_measure_distance(states[one], states[other])), one, other) for one in starts for other in stops
    )
    steps = motion.root_position[start : stop + 1, ::2].diff(dim=0).norm(dim=-1)
    return Cycle(start, stop, distance, periodic, float(steps.mean()) * float(motion.fps))


def _measure_phase(motion: Motion, cycle: Cycle) -> float:
    """Measure how far into the left foot's cycle the right foot's begins, 0 to 1: the phases of the first harmonic of
    how far the feet are ahead of the hips."""
    ahead = _see_from_hips(motion)[cycle.start : cycle.stop, list(TOE_JOINTS), 2]
    turns = torch.fft.rfft(ahead, dim=0)[1].angle()
    return float((turns[0] - turns[1]) / (2 * torch.pi) % 1)


def _measure_asymmetry(motion: Motion, cycle: Cycle) -> float:
    """Measure the mean distance of joints from their mirror image half a cycle later, metres."""
    places = _see_from_hips(motion)[cycle.start : cycle.stop]
    flip = places.new_tensor([-1.0, 1.0, 1.0])
    mirrored = places[:, motion.skeleton.mirror_partners()] * flip
    return float((places - mirrored.roll(cycle.frames // 2, dims=0)).norm(dim=-1).mean())
