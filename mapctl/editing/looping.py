"""A clip cut to its cycle and closed, so that it can be played again and again.

The cycle: two frames at which body and velocities are alike, one stride apart where it walks or runs. Joints are
compared from above the hips, in their heading, by the root of the mean over joints of |p - q|^2 + (0.1 s |v - w|)^2, as
in a motion graph (Kovar et al. 2002). The period is the shortest lag at which frames of the moving part recur.

The seam: frame `stop` of a cycle is carried back over the ground by the travel of the cycle and compared with frame
`start`; the difference in value, velocity and acceleration is shared by both sides and fades along polynomials of fifth
degree. Footing then holds planted toes still and on the floor by the legs, where contacts hold them.
"""

import math
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mapctl import contacts, rotations
from mapctl.contacts import compute_rest_log_probability, fit_supports
from mapctl.editing.rigged_motion import RiggedMotion, place_ankles
from mapctl.editing.travel import (
    GroundTransform,
    fit_ground_transform,
    move_by_share,
    repeat_over_ground,
    set_root_track,
)
from mapctl.errors import RequestError
from mapctl.motion import Motion
from mapctl.numerics import gaussian
from mapctl.numerics.easing import MinimumJerkTrack
from mapctl.numerics.intervals import true_intervals
from mapctl.numerics.smooth_offsets import interpolate_offsets
from mapctl.retarget.rigs import Rig
from mapctl.skeleton import TOE_JOINTS

_MEDIAN_OF_NORMAL = 0.6745  # of the size of a normal variable, in standard deviations
_NOISE_FRAMES = 12  # frames from which noise is estimated
_NOISE_SPEED = 0.04  # m/s that noise of toes makes once they are smoothed, before contacts are looked for
_SMOOTH_SECONDS = (0.04, 0.15)  # least and greatest standard deviation of that Gaussian
_MERGE_SECONDS, _MERGE_METRES = 0.15, 0.06  # contacts at one position with less than these between them are one
_ROLL_METRES = 0.005  # over its usual height in a contact, from which a planted toe is moving down or up
_STEP_FADE_SECONDS = 0.12  # over which a foot comes to its position and leaves it: a swing foot moves that little


def plant_feet(motion: Motion, rig: Rig | None = None, cycle: GroundTransform | None = None) -> Motion:
    """Hold planted toes still and on the floor, on the motion's own rig at its own rate.

    A toe is planted where it rests and carries the body (see `mapctl.contacts`), noise smoothed away; then it
    stays where it is on average during that contact, at the height of its support. Thighs and shins bring it there,
    feet keep their orientation, and hips go down where a leg is too short. All other local rotations stay to the bit.
    `cycle` is the travel of a loop, which stays one. `rig` wins over what would be recognised; RequestError where the
    rig's joints cannot be identified.
    """
    rigged = RiggedMotion.of(motion, rig)
    if cycle is None:
        return rigged.with_motion(_plant(rigged)).in_file_world(motion)
    frames = motion.num_frames
    around = rigged.with_motion(repeat_over_ground(rigged.motion, cycle, 3))
    middle = _plant(around).slice(frames, 2 * frames)
    planted = move_by_share(middle, cycle, -torch.ones(frames, dtype=torch.float64))
    return rigged.with_motion(planted).in_file_world(motion)


def _plant(rigged: RiggedMotion) -> Motion:
    toes, fps = rigged.positions("Toes"), float(rigged.motion.fps)
    planted = find_contacts(toes, rigged.position("hips"), fps)
    if not bool(planted.any()):
        return rigged.motion
    corrections = correct_toes(toes, toes, planted, fps)
    # Planted toes are at the height of their support, and none is lower. The ends of a contact, in which a toe is on
    # its way down or up, are left to what is between.
    smooth, heights = gaussian.smooth(toes, choose_smoothing(toes, fps)), toes[..., 1]
    rest = fit_supports(smooth, planted)
    firm = heights < rest
    for foot, start, stop in true_intervals(planted):
        usual = smooth[start:stop, foot, 1].median()
        firm[start:stop, foot] |= smooth[start:stop, foot, 1] < usual + _ROLL_METRES
    for foot in range(2):
        missed = torch.where(firm, rest - heights, 0.0)[:, foot, None]
        corrections[:, foot, 1:2] = interpolate_offsets(missed, firm[:, foot], seconds=_STEP_FADE_SECONDS, fps=fps)
    return place_ankles(rigged, rigged.positions("Foot") + corrections)


def find_contacts(
    toes: Float[Tensor, "frames 2 3"], hips: Float[Tensor, "frames 3"], fps: float
) -> Bool[Tensor, "frames 2"]:
    """Find in which frames each toe is planted; contacts that noise alone parts are one. Positions in metres."""
    sigma = choose_smoothing(toes, fps)
    smooth = gaussian.smooth(toes, sigma)
    noise = torch.tensor([[_NOISE_SPEED]])
    resting = compute_rest_log_probability(smooth, hips, fps, noise)
    if sigma <= _SMOOTH_SECONDS[0] * fps:  # hardly any noise: what is seen as it is counts too
        resting = resting.maximum(compute_rest_log_probability(toes, hips, fps, noise))
    shortest = max(1, round(contacts.ContactSettings().shortest * fps))
    planted = contacts.remove_short_runs(resting > math.log(0.5), shortest)
    for foot, start, stop in list(true_intervals(~planted)):
        inside = start > 0 and stop < len(planted)
        if inside and stop - start < _MERGE_SECONDS * fps:
            apart = (smooth[start - 1, foot] - smooth[stop, foot])[::2].norm()
            planted[start:stop, foot] |= bool(apart < _MERGE_METRES)
    return planted


def correct_toes(
    toes: Float[Tensor, "frames 2 3"], drift: Float[Tensor, "frames 2 3"], planted: Bool[Tensor, "frames 2"], fps: float
) -> Float[Tensor, "frames 2 3"]:
    """Return corrections of toe positions, metres, that take the drift out of each contact but for its mean, and are
    smooth between contacts. Drift equal to the positions leaves toes quite still."""
    corrections = torch.zeros_like(toes)
    for foot, start, stop in true_intervals(planted):
        own = drift[start:stop, foot]
        corrections[start:stop, foot] = own.mean(dim=0) - own
    feet = zip(corrections.unbind(dim=1), planted.unbind(dim=1), strict=True)
    return torch.stack([interpolate_offsets(*foot, seconds=_STEP_FADE_SECONDS, fps=fps) for foot in feet], dim=1)


def choose_smoothing(toes: Float[Tensor, "frames 2 3"], fps: float) -> float:
    """Choose the standard deviation in frames of the Gaussian that leaves so little of the noise."""
    # White noise of 1 makes third differences of 20 in the square; most frames have little else. Of it a Gaussian of s
    # frames leaves velocities of (4 sqrt(pi) s^3)^-1/2 a frame.
    least, most = (seconds * fps for seconds in _SMOOTH_SECONDS)
    if len(toes) < _NOISE_FRAMES:
        return least
    sizes = toes[..., ::2].diff(n=3, dim=0).abs().flatten()
    noise = float(sizes.median()) / _MEDIAN_OF_NORMAL / math.sqrt(20)
    wanted = ((noise * fps / _NOISE_SPEED) ** 2 / (4 * math.sqrt(math.pi))) ** (1 / 3)
    return min(max(wanted, least), most)


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

    RequestError where none is found, with what comes nearest.
    """
    step = max(1, round(float(motion.fps) / SEARCH_FPS))
    rate, count = float(motion.fps) / step, -(-motion.num_frames // step)
    lags = range(round(_SHORTEST_SECONDS * rate), min(round(_LONGEST_SECONDS * rate), count - 2) + 1)
    if len(lags) < 3:
        raise RequestError(f"no cycle is found: {motion.seconds:.2f} s are too short for one")
    states = _describe_frames(motion, step)
    distances = torch.full((len(lags), count), float("inf"), dtype=states.dtype)
    for row, lag in enumerate(lags):
        distances[row, : count - lag] = _measure_distance(states[::step][:-lag], states[::step][lag:])
    # By lag and frame: whether both frames are there and move, and whether a contact of each foot lies between them.
    speed = states[::step, :, 3:].square().sum(dim=-1).mean(dim=-1).sqrt()
    moves = speed >= _MOVING_SHARE * speed.quantile(_FAST_QUANTILE)
    later = torch.nn.functional.pad(moves, (0, lags[-1])).unfold(0, count, 1)[lags[0] :]
    moving = moves & later & distances.isfinite()
    covered = _cover_steps(motion, step, lags)
    limit = min(_MAX_DISTANCE, _MAX_SHARE * float(distances[moving].mean())) if bool(moving.any()) else 0.0
    # Pairs about each period, the shortest first, and at last any a second apart.
    lag = torch.tensor(list(lags))[:, None]
    periods = _find_periods(distances, moving, lags)
    searches = [(moving & ((lag - period).abs() <= _NEAR_PERIOD * period), True) for period in periods]
    best = None
    for fits, periodic in (*searches, (moving & (lag >= _SHORTEST_FREE_SECONDS * rate), False)):
        known = int((fits & covered).sum()) > _KNOWN_SHARE * int(fits.sum())
        allowed = fits & covered if known else fits
        if not bool(allowed.any()):
            continue
        row, start = divmod(int(torch.where(allowed, distances, torch.inf).argmin()), count)
        found = _refine(motion, states, start * step, (start + lags[row]) * step, step, periodic)
        if found.distance <= limit:
            return found
        best = found if best is None or found.distance < best.distance else best
    if best is None:
        raise RequestError("no cycle is found: the clip never comes back to where it was in a stride or a second")
    raise RequestError(
        f"no cycle is found: frames {best.start} and {best.stop} come nearest, with joints and velocities"
        f" {100 * best.distance:.1f} cm apart; {100 * limit:.1f} are allowed"
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
    return values | {"steps_per_minute": 120 / seconds, "stride_m": stride, "speed_m_s": stride / seconds}


def _describe_frames(motion: Motion, step: int) -> Float[Tensor, "frames joints 6"]:
    """Describe frames by joint positions from below the hips, which face +Z, and velocities (times 0.1 s), metres."""
    back = -rotations.split_heading(motion.joint_rotations()[:, 0])[0][:, None]
    frames = torch.arange(motion.num_frames)
    before, after = (frames - step).clamp(min=0), (frames + step).clamp(max=motion.num_frames - 1)
    seconds = (after - before).clamp(min=1).double() / float(motion.fps)
    positions = motion.joint_positions()
    velocity = (positions[after] - positions[before]) / seconds[:, None, None]
    below = motion.root_position * motion.root_position.new_tensor([1.0, 0.0, 1.0])
    seen = rotations.rotate_about_y(positions - below[:, None], back)
    return torch.cat([seen, _VELOCITY_SECONDS * rotations.rotate_about_y(velocity, back)], dim=-1)


def _measure_distance(
    one: Float[Tensor, "*batch joints 6"], other: Float[Tensor, "*batch joints 6"]
) -> Float[Tensor, "*batch"]:
    return (one - other).square().sum(dim=-1).mean(dim=-1).sqrt()


def _find_periods(
    distances: Float[Tensor, "lags frames"], moving: Bool[Tensor, "lags frames"], lags: range
) -> list[int]:
    """Find the lags at which the mean distance of moving frames has a clear local minimum, the shortest first."""
    profile = torch.where(moving, distances, 0.0).sum(dim=1) / moving.sum(dim=1)
    usual = profile.nanmean()
    return [
        lags[row]
        for row in range(1, len(profile) - 1)
        if profile[row] <= profile[row - 1] and profile[row] <= profile[row + 1] and profile[row] < _CLEAR_DIP * usual
    ]


def _cover_steps(motion: Motion, step: int, lags: range) -> Bool[Tensor, "lags frames"]:
    """Return which pairs have a contact of each foot and a swing of each between them."""
    positions = motion.joint_positions()
    planted = find_contacts(positions[:, list(TOE_JOINTS)], positions[:, 0], float(motion.fps))[::step]
    counts = torch.nn.functional.pad(planted.long().cumsum(dim=0), (0, 0, 1, 0))
    lag, frames = torch.tensor(list(lags))[:, None], torch.arange(len(planted))
    between = counts[(frames + lag).clamp(max=len(planted))] - counts[frames]
    return ((between > 0) & (between < lag[..., None])).all(dim=-1)


def _refine(motion: Motion, states: Tensor, start: int, stop: int, step: int, periodic: bool) -> Cycle:
    """Choose the two frames around a pair that are most alike, at the clip's own rate."""
    starts = range(max(0, start - step + 1), start + step)
    stops = range(stop - step + 1, min(motion.num_frames, stop + step))
    pairs = product(starts, stops)
    distance, start, stop = min((float(_measure_distance(states[a], states[b])), a, b) for a, b in pairs)
    steps = motion.root_position[start : stop + 1, ::2].diff(dim=0).norm(dim=-1)
    return Cycle(start, stop, distance, periodic, float(steps.mean()) * float(motion.fps))


_WINDOW_SECONDS = 0.1  # seconds on both sides of the seam over which its ends are compared
_FADE_SECONDS = 0.75  # seconds within which what closes the seam fades away, half a cycle at most
_STRAIGHT = np.deg2rad(6.0)  # radians a cycle, up to which it is taken for straight
_STILL_METRES = 0.01  # metres by which a root joint that stays in place moves at most


@dataclass(frozen=True, eq=False)
class Loop:
    """A motion that can be repeated."""

    motion: Motion
    """One cycle: the frame after its last is its first one, moved by the travel."""
    cycle: Cycle
    """Where it was in the clip."""
    travel: GroundTransform
    """How far it moves over the ground by cycle, in a world with Y up."""


def close_loop(motion: Motion, rig: Rig | None = None) -> Loop:
    """Find the cycle of a motion, cut to it, and close it, on the motion's own rig and in its layout.

    Of a walk or a run it is one stride; one that turns by up to 6 degrees is straightened. `rig` wins over what would
    be recognised. RequestError where its joints cannot be identified, and where no cycle is found.
    """
    rigged, fps = RiggedMotion.of(motion, rig), float(motion.fps)
    cycle = find_cycle(rigged.canonical)
    reach = max(1, round(_WINDOW_SECONDS * fps))
    # How the body moves over the ground from the cycle's beginning to its end, all joints and frames around.
    positions = rigged.canonical.joint_positions()
    back, on = min(reach, cycle.start), min(reach, len(positions) - 1 - cycle.stop)
    around = [positions[frame - back : frame + on + 1] for frame in (cycle.start, cycle.stop)]
    travel = fit_ground_transform(*around)
    travel = travel if abs(travel.turn) > _STRAIGHT else fit_ground_transform(*around, turning=False)
    first, last = max(0, cycle.start - reach), min(motion.num_frames, cycle.stop + reach + 1)
    window, start = _carry_root(rigged, cycle, travel, first, last), cycle.start - first
    shares = (torch.arange(first, last) - cycle.start).double() / cycle.frames
    closed = _close(move_by_share(window, travel, -shares), start, cycle.frames, reach, fps)
    closed = rigged.with_motion(move_by_share(closed, travel, shares[start:][: cycle.frames]))
    planted = find_contacts(rigged.positions("Toes"), rigged.position("hips"), fps)[cycle.start : cycle.stop]
    source = rigged.with_motion(window.slice(start, start + cycle.frames + 1))
    loop, child = _restore_contacts(closed, source, planted, travel), _carrier(rigged)
    own = rigged.motion.slice(cycle.start, cycle.stop)
    away = float((own.root_position - own.root_position[0]).norm(dim=-1).max())
    if child is not None and away <= _STILL_METRES:  # a root joint that stays in place in the clip stays there
        position, turn = (each[:1].expand_as(each).clone() for each in (own.root_position, own.local_quat_xyzw[:, 0]))
        loop = set_root_track(loop, position, turn, [child])
    return Loop(rigged.with_motion(loop).in_file_world(), cycle, travel)


def _carrier(rigged: RiggedMotion) -> int | None:
    """Return the child of joint 0 that travels below it with the hips; None where joint 0 itself carries them."""
    joint, parents = rigged.hips, rigged.motion.skeleton.parents
    while joint and parents[joint]:
        joint = parents[joint]
    return joint if joint and joint in rigged.motion.moving_offsets else None


def _carry_root(rigged: RiggedMotion, cycle: Cycle, travel: GroundTransform, first: int, last: int) -> Motion:
    """Return frames of the motion in which a root joint above the hips goes evenly with the cycle's travel."""
    window, child = rigged.motion.slice(first, last), _carrier(rigged)
    if child is None:
        return window
    turns, shifts = travel.share((torch.arange(first, last) - cycle.start).double() / cycle.frames)
    start, turn = rigged.motion.root_position[cycle.start], rigged.motion.local_quat_xyzw[cycle.start, 0]
    position = rotations.rotate_about_y(start.expand(len(turns), 3), turns) + rotations.lift_ground(shifts)
    turned = rotations.multiply(rotations.about_y(turns), turn)
    return set_root_track(window, position, turned, [child])


def _close(still: Motion, start: int, frames: int, reach: int, fps: float) -> Motion:
    """Return the cycle's frames of a motion that has no travel, such that the last is followed by the first."""
    back, on = min(reach, start), min(reach, still.num_frames - 1 - start - frames)
    before, after = (still.slice(frame - back, frame + on + 1) for frame in (start, start + frames))
    turns = rotations.to_rotation_vector(
        rotations.multiply(rotations.inverse(before.local_quat_xyzw), after.local_quat_xyzw)
    )
    apart = {
        "root": after.root_position - before.root_position,
        "turns": turns.flatten(1),
        **{f"{j}": after.moving_offsets[j] - track for j, track in before.moving_offsets.items()},
    }
    whole = torch.cat(list(apart.values()), dim=-1)
    offsets = _spread(whole, back, frames, fps).split([track.shape[1] for track in apart.values()], dim=-1)
    added = dict(zip(apart, offsets, strict=True))
    cut = still.slice(start, start + frames)
    turned = rotations.from_rotation_vector(added["turns"].unflatten(-1, (-1, 3)))
    return replace(
        cut,
        root_position=cut.root_position + added["root"],
        local_quat_xyzw=rotations.make_sign_continuous(rotations.multiply(cut.local_quat_xyzw, turned)),
        moving_offsets={j: track + added[f"{j}"] for j, track in cut.moving_offsets.items()},
    )


def _spread(apart: Float[Tensor, "window width"], at: int, frames: int, fps: float) -> Float[Tensor, "frames width"]:
    """Return offsets of a cycle's frames that close its seam, half at each end; `apart` is how far the end is from the
    beginning in the frames around the seam, which is frame `at` of them."""
    seconds = (torch.arange(len(apart)) - at).double().numpy() / fps
    degree = min(2, len(apart) - 1)
    powers = np.vander(seconds, degree + 1, increasing=True)
    fitted = np.linalg.lstsq(powers, apart.numpy(), rcond=None)[0]
    value, velocity, bend = (
        torch.from_numpy(factor * fitted[order]) if order <= degree else apart.new_zeros(apart.shape[1])
        for order, factor in enumerate((0.5, 0.5, 1.0))
    )
    fade = min(_FADE_SECONDS, frames / (2 * fps))
    beginning = MinimumJerkTrack(value, velocity, bend, 0 * value, fade)
    end = MinimumJerkTrack(-value, velocity, -bend, 0 * value, fade)  # time runs back from the seam
    offsets = apart.new_zeros(frames, apart.shape[1])
    for frame in range(min(frames, int(fade * fps) + 1)):
        offsets[frame] += beginning.move(frame / fps).value
        offsets[frames - 1 - frame] += end.move((frame + 1) / fps).value
    return offsets


def _restore_contacts(
    closed: RiggedMotion, source: RiggedMotion, planted: Bool[Tensor, "frames 2"], travel: GroundTransform
) -> Motion:
    """Remove from planted feet the drift that closing adds; `source` are the same frames before, and one more."""
    if not bool(planted.any()):
        return closed.motion
    frames = closed.motion.num_frames
    around = closed.with_motion(repeat_over_ground(closed.motion, travel, 3))
    toes, steps = around.positions("Toes"), source.positions("Toes").diff(dim=0)
    rounds = torch.arange(3).double().repeat_interleave(frames)[:, None]
    steps = rotations.rotate_about_y(steps.repeat(3, 1, 1), rounds * travel.turn)
    drift = torch.zeros_like(toes)
    drift[1:] = (toes.diff(dim=0) - steps[:-1]).cumsum(dim=0)
    corrections = correct_toes(toes, drift, planted.repeat(3, 1), float(closed.motion.fps))[frames : 2 * frames]
    corrections = rotations.rotate_about_y(corrections, torch.tensor(-travel.turn).double())
    return place_ankles(closed, closed.positions("Foot") + corrections)
