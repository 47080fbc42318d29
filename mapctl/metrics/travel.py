"""Command tracking of a steered character: speed and direction of its slow velocity against the commands."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import scipy
from jaxtyping import Float
from numpy import ndarray
from torch import Tensor

from mapctl import contacts, rotations
from mapctl.curves.obstacles import measure_clearance
from mapctl.intent.steering import Arrival, Command, CommandTrack
from mapctl.joint_roles import find_feet
from mapctl.kinematics import heading
from mapctl.kinematics.moving import measure_look_angle
from mapctl.metrics.gait import step_lengths
from mapctl.motion import Motion

_SLOW_SECONDS = 0.25  # a Gaussian that removes a stride's own rise and fall of speed
_HELD_DISTANCE = 0.01  # metres from its position within which a hand is there
_STEADY_AFTER = 2.0  # seconds: from then on a command counts as obeyed or not
_HOLD_SECONDS = 0.4  # seconds for which a command must hold to count as reached
_UNDER_WAY_SHARE, _UNDER_WAY_ANGLE = 0.5, math.radians(30)  # of the speed; radians off the direction
_NEAR_SPEED, _NEAR_STILL = 0.15, 0.15  # share of the speed; m/s at rest
_NEAR_ANGLE, _NEAR_FACING = math.radians(10), math.radians(15)  # radians of travel, and of the facing while it goes


class _SlowTravel(NamedTuple):
    """Slow velocity of the hips over the ground and their slow facing, frame by frame."""

    seconds: Float[ndarray, " frames"]
    speed: Float[ndarray, " frames"]  # m/s
    direction: Float[ndarray, " frames"]  # of travel, radians about +Y; meaningless where the speed is near 0
    facing: Float[ndarray, " frames"]  # of the hips, radians about +Y


def measure_commands(motion: Motion, track: CommandTrack) -> list[dict[str, float | None]]:
    """Measure a row for each command: when it was reached, and the steady errors from 2 s after it to the next one.

    Keys: time_s, speed_mps, heading_deg, turn_deg_s (wanted; None unless it is to turn on and on), reached_s (None if
    it never was), under_way_s (from when on it goes at half the speed and more within 30 degrees of the direction; None
    if never, and where standing or turning on and on was wanted), steady_speed_mps (net displacement over time; mean
    speed while turning), steady_heading_error_deg and steady_turn_deg_s (None where the other, standing, or no steady
    part was wanted), facing_deg (wanted, the direction of travel unless another was given; None while turning on and
    on) and steady_facing_error_deg, step_m and steady_step_m (None unless a step length was wanted). For each hand with
    a position: `<hand>_nearest_cm`, and `<hand>_held_s`, the seconds in which it was within a centimetre of it;
    `look_nearest_deg`, the least angle between where the head faces and what is looked at; `clearance_cm`, of the
    nearest joint to an obstacle.
    """
    positions, fps, rows = motion.joint_positions(), float(motion.fps), []
    ground = positions[:, 0, ::2].numpy()
    facing = rotations.unwrap_angle(heading(motion.local_quat_xyzw[:, 0])).numpy()
    moving = np.column_stack([np.gradient(ground, axis=0) * fps, facing])
    slow = scipy.ndimage.gaussian_filter1d(moving, _SLOW_SECONDS * fps, axis=0, mode="nearest")
    seconds, directions = np.arange(len(ground)) / fps, np.arctan2(slow[:, 0], slow[:, 1])
    velocity = _SlowTravel(seconds, np.linalg.norm(slow[:, :2], axis=-1), directions, slow[:, 2])
    toes = positions[:, list(find_feet(motion.skeleton))]
    steps = step_lengths(toes[..., ::2], contacts.detect_contacts(toes, fps), fps).numpy()
    ends = [*track.times[1:], float(velocity.seconds[-1])]
    for began, until, command in zip(track.times, ends, track.commands, strict=True):
        part = (velocity.seconds >= began) & (velocity.seconds <= until)
        turning = None if command.turning is None else math.degrees(command.turning)
        row: dict[str, float | None] = {
            "time_s": began,
            "speed_mps": command.speed,
            "turn_deg_s": turning,
            "heading_deg": math.degrees(command.heading),
            "facing_deg": None if command.turning is not None else math.degrees(command.hips_heading),
        }
        row["reached_s"] = _find_time_reached(velocity, part, began, command, float(motion.fps))
        row["under_way_s"] = _find_travel_time(velocity, part, began, command)
        steady = np.flatnonzero(part & (velocity.seconds >= began + _STEADY_AFTER))
        row |= _measure_steady_errors(velocity, ground, steady, command, float(motion.fps))
        taken = steps[steady][~np.isnan(steps[steady])] if command.step_length is not None else ()
        row |= {"step_m": command.step_length, "steady_step_m": float(np.mean(taken)) if len(taken) else None}
        rows.append(row | _measure_positions(motion, positions, np.flatnonzero(part), command))
    return rows


def _measure_positions(motion: Motion, positions: Tensor, frames: ndarray, command: Command) -> dict[str, float | None]:
    """Measure what came of the positions that a command names, over its frames."""
    found: dict[str, float | None] = {}
    if not len(frames):
        return found
    for hand, position in command.reach.items():
        away = (positions[frames, motion.skeleton.index(hand)] - positions.new_tensor(position)).norm(dim=-1)
        found[f"{hand}_nearest_cm"] = 100 * float(away.min())
        found[f"{hand}_held_s"] = float((away < _HELD_DISTANCE).sum()) / float(motion.fps)
    if command.look_at is not None:
        looked = measure_look_angle(motion, positions.new_tensor([command.look_at]))[frames]
        found["look_nearest_deg"] = math.degrees(float(looked.min()))
    if command.obstacles:
        found["clearance_cm"] = 100 * float(measure_clearance(command.obstacles, positions[frames][..., ::2]).min())
    return found


def _find_time_reached(
    velocity: _SlowTravel, part: ndarray, began: float, command: Command, fps: float
) -> float | None:
    near = np.abs(velocity.speed - command.speed) < max(_NEAR_SPEED * command.speed, _NEAR_STILL)
    if command.turning is None:
        turned = np.abs(rotations.wrap_angle(velocity.facing - command.hips_heading))
        near &= turned < (_NEAR_FACING if command.speed > 0 else _NEAR_ANGLE)
    if command.speed > 0 and command.turning is None:
        near &= np.abs(rotations.wrap_angle(velocity.direction - command.heading)) < _NEAR_ANGLE
    at, held = np.flatnonzero(part), round(_HOLD_SECONDS * fps)
    for first in at[: max(0, len(at) - held + 1)]:
        if near[first : first + held].all():
            return float(velocity.seconds[first] - began)
    return None


def _find_travel_time(velocity: _SlowTravel, part: ndarray, began: float, command: Command) -> float | None:
    if command.speed == 0 or command.turning is not None:
        return None
    along = velocity.speed * np.cos(velocity.direction - command.heading)
    near = (along >= _UNDER_WAY_SHARE * command.speed) & (along >= math.cos(_UNDER_WAY_ANGLE) * velocity.speed)
    at = np.flatnonzero(part & near)
    return float(velocity.seconds[at[0]] - began) if len(at) else None


def _measure_steady_errors(
    velocity: _SlowTravel, ground: ndarray, frames: ndarray, command: Command, fps: float
) -> dict[str, float | None]:
    found: dict[str, float | None] = dict.fromkeys(
        ("steady_speed_mps", "steady_heading_error_deg", "steady_facing_error_deg", "steady_turn_deg_s")
    )
    if len(frames) < fps / 2:
        return found
    if command.turning is not None:
        turned = np.unwrap(velocity.direction[frames])
        rate = math.degrees(float(turned[-1] - turned[0])) * fps / (len(frames) - 1)
        return found | {"steady_speed_mps": float(velocity.speed[frames].mean()), "steady_turn_deg_s": rate}
    step = (ground[frames[-1]] - ground[frames[0]]) * fps / (len(frames) - 1)
    off = math.degrees(float(rotations.wrap_angle(math.atan2(step[0], step[1]) - command.heading)))
    found["steady_speed_mps"] = float(np.linalg.norm(step))
    turned = float(velocity.facing[frames].mean()) - command.hips_heading
    found["steady_facing_error_deg"] = math.degrees(float(rotations.wrap_angle(turned)))
    return found | {"steady_heading_error_deg": off if command.speed > 0 else None}


def measure_arrivals(
    motion: Motion, track: CommandTrack, refused: Sequence[Arrival] = ()
) -> list[dict[str, float | int | None]]:
    """Measure a row for each order of a track whose time is within a canonical motion, but for those refused.

    Keys: `ordered_s` and `by_s`, seconds; `goto_x_m`, `goto_z_m` and `goto_facing_deg` (None where none was wanted);
    `frame`, on which it was to be there; `position_error_cm` and `facing_error_deg` of the hips on that frame;
    `pose_error_cm`, the mean distance of the joints from the wanted pose, both seen from the hips and their facing
    (None where none was wanted).
    """
    rows = []
    for time, command in zip(track.times, track.commands, strict=True):
        order = None if command.arrival in refused else command.arrival
        frame = None if order is None else round(order.by * float(motion.fps))
        if order is None or frame is None or frame >= motion.num_frames:
            continue
        x, _, z = motion.root_position[frame].tolist()
        facing = float(heading(motion.local_quat_xyzw[frame : frame + 1, 0])[0])
        off = None if order.facing is None else math.degrees(abs(math.remainder(facing - order.facing, 2 * math.pi)))
        rows.append(
            {
                "ordered_s": time,
                "by_s": order.by,
                "goto_x_m": order.position[0],
                "goto_z_m": order.position[1],
                "goto_facing_deg": None if order.facing is None else math.degrees(order.facing),
                "frame": frame,
                "position_error_cm": 100 * math.dist((x, z), order.position),
                "facing_error_deg": off,
                "pose_error_cm": _measure_pose(motion.slice(frame, frame + 1), order),
            }
        )
    return rows


def _measure_pose(found: Motion, order: Arrival) -> float | None:
    if order.pose is None:
        return None
    positions = []
    for one in (found, order.pose):
        turn = rotations.about_y(-heading(one.local_quat_xyzw[:, 0]))[:, None]
        joints = one.joint_positions()
        positions.append(rotations.rotate(turn.expand(1, joints.shape[1], 4), joints - joints[:, :1]))
    scale = float(positions[0].norm(dim=-1).mean() / positions[1].norm(dim=-1).mean())
    return 100 * float((positions[0] - scale * positions[1]).norm(dim=-1).mean())
