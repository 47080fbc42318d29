"""A clip cut to its cycle and closed, so that it can be played again and again.

Frame `stop` of a cycle is carried back over the ground by the travel of the cycle and compared with frame `start`: what
is missing to equality, in value, velocity and acceleration, is shared by both sides of the seam, and fades away from it
along polynomials of fifth degree. Then legs bring the feet back to where their contacts hold them.
"""

from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mapctl import rotations
from mapctl.editing.cycles import Cycle, find_cycle
from mapctl.editing.footing import correct_toes, find_contacts
from mapctl.editing.ground_transform import GroundTransform, fit_ground_transform, move_by_share, repeat_over_ground
from mapctl.editing.legs import place_ankles
from mapctl.editing.rigged_motion import RiggedMotion
from mapctl.editing.root_joint import set_root_track
from mapctl.motion import Motion
from mapctl.numerics.minimum_jerk import MinimumJerkTrack
from mapctl.retarget.rigs import Rig

_WINDOW_SECONDS = 0.1  # seconds on both sides of the seam over which its ends are compared
_FADE_SECONDS = 0.75  # seconds within which what closes the seam fades away, half a cycle at most
_STRAIGHT = np.deg2rad(6.0)  # radians a cycle, up to which it is taken for straight
_STILL_METRES = 0.01  # metres by which a root joint that stays in place moves at most
_SEAM_FRAMES = 2  # frames on both sides of a seam whose steps and accelerations are its own


@dataclass(frozen=True)
class Peaks:
    """Peaks of any joint in the world."""

    step: float
    """Largest displacement from frame to frame, metres."""
    acceleration: float
    """Largest acceleration, m/s^2."""

    @staticmethod
    def of(places: Float[Tensor, "frames joints 3"], fps: float) -> "Peaks":
        """Measure joint positions, metres; 0 for too few frames."""
        steps, bends = (places.diff(n=order, dim=0).norm(dim=-1) for order in (1, 2))
        return Peaks(*(float(v.max()) * scale if v.numel() else 0.0 for v, scale in ((steps, 1.0), (bends, fps**2))))


@dataclass(frozen=True, eq=False)
class Loop:
    """A motion that can be repeated."""

    motion: Motion
    """One cycle: the frame after its last is its first one, moved by the travel."""
    cycle: Cycle
    """Where it was in the clip."""
    travel: GroundTransform
    """How far it moves over the ground by cycle, in a world with Y up."""
    clip: Peaks
    """Peaks of the same frames in the clip."""
    seam: Peaks
    """Peaks where the last frames are followed by the first."""


def close_loop(motion: Motion, rig: Rig | None = None) -> Loop:
    """Find the cycle of a motion, cut to it, and close it, on the motion's own rig and in its layout.

    Of a walk or a run it is one stride; one that turns by up to 6 degrees is made straight. `rig` wins over what would
    be recognised. RequestError where its joints cannot be identified, and where no cycle is found.
    """
    rigged = RiggedMotion.of(motion, rig)
    cycle = find_cycle(rigged.canonical)
    reach = max(1, round(_WINDOW_SECONDS * float(motion.fps)))
    travel = _fit_travel(rigged, cycle, reach)
    first, last = max(0, cycle.start - reach), min(motion.num_frames, cycle.stop + reach + 1)
    window = _carry_root(rigged, cycle, travel, first, last)
    shares = (torch.arange(first, last) - cycle.start).double() / cycle.frames
    still = move_by_share(window, travel, -shares)
    closed = _close(still, cycle.start - first, cycle.frames, reach, float(motion.fps))
    closed = move_by_share(closed, travel, shares[cycle.start - first :][: cycle.frames])
    planted = find_contacts(rigged.positions("Toes"), rigged.position("hips"), float(motion.fps))
    planted = planted[cycle.start : cycle.stop]
    source = rigged.with_motion(window.slice(cycle.start - first, cycle.start - first + cycle.frames + 1))
    closed = _restore_contacts(rigged.with_motion(closed), source, planted, travel)
    seam = _measure_seam(closed, travel)
    loop = _restore_root(rigged, closed, cycle)
    made = rigged.with_motion(loop).in_file_world()
    own = motion.joint_positions()[cycle.start : cycle.stop + 1]
    return Loop(made, cycle, travel, Peaks.of(own, float(motion.fps)), seam)


def _fit_travel(rigged: RiggedMotion, cycle: Cycle, reach: int) -> GroundTransform:
    """Fit how the body moves over the ground from the cycle's beginning to its end, all joints and frames around."""
    places = rigged.canonical.joint_positions()
    back, on = min(reach, cycle.start), min(reach, len(places) - 1 - cycle.stop)
    before, after = (places[frame - back : frame + on + 1] for frame in (cycle.start, cycle.stop))
    travel = fit_ground_transform(before, after)
    return travel if abs(travel.turn) > _STRAIGHT else fit_ground_transform(before, after, turning=False)


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
    place = rotations.rotate_about_y(start.expand(len(turns), 3), turns) + rotations.lift_ground(shifts)
    turned = rotations.multiply(rotations.about_y(turns), turn.expand(len(turns), 4))
    return set_root_track(window, place, turned, [child])


def _restore_root(rigged: RiggedMotion, closed: Motion, cycle: Cycle) -> Motion:
    """Put a root joint that stays in place in the clip back there."""
    child = _carrier(rigged)
    own = rigged.motion.slice(cycle.start, cycle.stop)
    if child is None or float((own.root_position - own.root_position[0]).norm(dim=-1).max()) > _STILL_METRES:
        return closed
    frames = cycle.frames
    place, turn = own.root_position[:1].expand(frames, 3), own.local_quat_xyzw[:1, 0].expand(frames, 4)
    return set_root_track(closed, place.clone(), turn.clone(), [child])


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
    """Return offsets of a cycle's frames which take away by what its ends are apart, half at each end.

    `apart` is how far the end is from the beginning in the frames around the seam, which is frame `at` of them.
    """
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
    """Take out of planted feet by what closing the cycle made them drift; over the seam too. `source` are the same
    frames before, and one more."""
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


def _measure_seam(motion: Motion, travel: GroundTransform) -> Peaks:
    twice = repeat_over_ground(motion, travel, 2)
    near = slice(max(0, motion.num_frames - _SEAM_FRAMES), motion.num_frames + _SEAM_FRAMES)
    return Peaks.of(twice.joint_positions()[near], float(motion.fps))
