"""Command tracking of a steered character: what came of each field of its commands, and which were not obeyed."""

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

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
from mapctl.metrics.gait import RUN_FLIGHT, find_gait, measure_flight, step_lengths
from mapctl.motion import Motion

_SLOW_SECONDS = 0.25  # a Gaussian that removes a stride's own rise and fall of speed
_HELD_DISTANCE = 0.01  # metres from its position within which a hand is there
_STEADY_AFTER = 2.0  # seconds: from then on a command counts as obeyed or not
_HOLD_SECONDS = 0.4  # seconds for which a command must hold to count as reached
_NEAR_SHARE, _NEAR_STILL = 0.15, 0.15  # share of the speed, of turning and of a step's length; m/s at rest
_NEAR_DEG, _NEAR_FACING_DEG = 10.0, 15.0  # of travel, turning a second and a stand; of facing and look while it goes
_ARRIVAL_LIMITS = (
    ("position_error_cm", 0.0, 100 * _HELD_DISTANCE, "hips {:.0f} cm off their position"),
    ("facing_error_deg", 0.0, 1.0, "hips facing {:.0f} degrees off at their position"),
    ("pose_error_cm", 0.0, 100 * _HELD_DISTANCE, "joints {:.0f} cm off the pose"),
)


class _SlowTravel(NamedTuple):
    """Slow velocity of the hips over the ground and their slow facing, frame by frame."""

    seconds: Float[ndarray, " frames"]
    speed: Float[ndarray, " frames"]  # m/s
    direction: Float[ndarray, " frames"]  # of travel, radians about +Y; meaningless where the speed is near 0
    facing: Float[ndarray, " frames"]  # of the hips, radians about +Y


def measure_commands(motion: Motion, track: CommandTrack) -> list[dict[str, Any]]:
    """Measure a row for each command: when it was reached, and the steady errors from 2 s after it, or after the
    position that it is to reach first, to the next one; they are None where this lasts less than half a second.

    Keys: time_s, speed_mps, heading_deg, turn_deg_s (wanted; None unless it is to turn on and on), reached_s (None if
    it never was), steady_speed_mps (net displacement over time; mean speed while turning), steady_heading_error_deg and
    steady_turn_deg_s (None where the other or standing was wanted), facing_deg (wanted, the direction of travel unless
    another was given; None where it turns on and on without one) and steady_facing_error_deg, step_m and steady_step_m
    (None unless a step length was wanted), gait (run or walk, where a label names it) and steady_flight_share, of the
    time without a planted toe. For each hand with a position: `<hand>_nearest_cm`, and `<hand>_held_s`, the seconds in
    which it was within a centimetre of it, over all commands with this position; `look_nearest_deg`, the least angle
    between where the head faces and what is looked at; `clearance_cm`, of the nearest joint to an obstacle.
    """
    positions, fps, rows = motion.joint_positions(), float(motion.fps), list[dict[str, Any]]()
    ground = positions[:, 0, ::2].numpy()
    facing = rotations.unwrap_angle(heading(motion.local_quat_xyzw[:, 0])).numpy()
    moving = np.column_stack([np.gradient(ground, axis=0) * fps, facing])
    slow = scipy.ndimage.gaussian_filter1d(moving, _SLOW_SECONDS * fps, axis=0, mode="nearest")
    seconds, directions = np.arange(len(ground)) / fps, np.arctan2(slow[:, 0], slow[:, 1])
    velocity = _SlowTravel(seconds, np.linalg.norm(slow[:, :2], axis=-1), directions, slow[:, 2])
    toes = positions[:, list(find_feet(motion.skeleton))]
    planted = contacts.detect_contacts(toes, fps)
    steps = step_lengths(toes[..., ::2], planted, fps).numpy()
    ends = [*track.times[1:], float(velocity.seconds[-1])]
    for began, until, command in zip(track.times, ends, track.commands, strict=True):
        part = (velocity.seconds >= began) & (velocity.seconds <= until)
        turning = None if command.turning is None else math.degrees(command.turning)
        facing = command.facing if command.turning is not None else command.hips_heading
        row = {
            "time_s": began,
            "speed_mps": command.speed,
            "turn_deg_s": turning,
            "heading_deg": math.degrees(command.heading),
            "facing_deg": None if facing is None else math.degrees(facing),
            "step_m": command.step_length,
            "gait": find_gait(command.labels),
        }
        row["reached_s"] = _find_time_reached(velocity, part, began, command, fps)
        settled = began if command.arrival is None else max(began, command.arrival.by)
        steady = np.flatnonzero(part & (velocity.seconds >= settled + _STEADY_AFTER))
        row |= _measure_steady_errors(velocity, ground, steady, command, fps)
        taken = steps[steady][~np.isnan(steps[steady])] if command.step_length is not None else ()
        row["steady_step_m"] = float(np.mean(taken)) if len(taken) else None
        row["steady_flight_share"] = measure_flight(planted[steady]) if len(steady) else None
        rows.append(row | _measure_positions(motion, positions, np.flatnonzero(part), command, track))
    return rows


def _measure_positions(
    motion: Motion, positions: Tensor, frames: ndarray, command: Command, track: CommandTrack
) -> dict[str, float]:
    """Measure what came of the positions that a command names, over its frames; of hands, over those of all commands of
    the track with the same position."""
    found: dict[str, float] = {}
    if not len(frames):
        return found
    fps = float(motion.fps)
    for hand, position in command.reach.items():
        wanted = [k for k in range(motion.num_frames) if track.at(k / fps).reach.get(hand) == position] or frames
        away = (positions[wanted, motion.skeleton.index(hand)] - positions.new_tensor(position)).norm(dim=-1)
        found[f"{hand}_nearest_cm"] = 100 * float(away.min())
        found[f"{hand}_held_s"] = float((away < _HELD_DISTANCE).sum()) / fps
    if command.look_at is not None:
        looked = measure_look_angle(motion, positions.new_tensor([command.look_at]))[frames]
        found["look_nearest_deg"] = math.degrees(float(looked.min()))
    if command.obstacles:
        found["clearance_cm"] = 100 * float(measure_clearance(command.obstacles, positions[frames][..., ::2]).min())
    return found


def _find_time_reached(
    velocity: _SlowTravel, part: ndarray, began: float, command: Command, fps: float
) -> float | None:
    near_speed, near_facing = _find_limits(command.speed)
    near = np.abs(velocity.speed - command.speed) < near_speed
    if command.turning is None:
        turned = np.abs(rotations.wrap_angle(velocity.facing - command.hips_heading))
        near &= turned < math.radians(near_facing)
    if command.speed > 0 and command.turning is None:
        near &= np.abs(rotations.wrap_angle(velocity.direction - command.heading)) < math.radians(_NEAR_DEG)
    at, held = np.flatnonzero(part), round(_HOLD_SECONDS * fps)
    for first in at[: max(0, len(at) - held + 1)]:
        if near[first : first + held].all():
            return float(velocity.seconds[first] - began)
    return None


def _find_limits(speed: float) -> tuple[float, float]:
    """Return the errors of speed, m/s, and facing, degrees, up to which a command of this speed is obeyed."""
    return max(_NEAR_SHARE * speed, _NEAR_STILL), _NEAR_FACING_DEG if speed > 0 else _NEAR_DEG


def _measure_steady_errors(
    velocity: _SlowTravel, ground: ndarray, frames: ndarray, command: Command, fps: float
) -> dict[str, float | None]:
    found: dict[str, float | None] = dict.fromkeys(
        ("steady_speed_mps", "steady_heading_error_deg", "steady_facing_error_deg", "steady_turn_deg_s")
    )
    if len(frames) < fps / 2:
        return found
    facing = command.facing if command.turning is not None else command.hips_heading
    if facing is not None:
        off = rotations.wrap_angle(float(velocity.facing[frames].mean()) - facing)
        found["steady_facing_error_deg"] = math.degrees(float(off))
    if command.turning is not None:
        turned = np.unwrap(velocity.direction[frames])
        rate = math.degrees(float(turned[-1] - turned[0])) * fps / (len(frames) - 1)
        return found | {"steady_speed_mps": float(velocity.speed[frames].mean()), "steady_turn_deg_s": rate}
    step = (ground[frames[-1]] - ground[frames[0]]) * fps / (len(frames) - 1)
    off = math.degrees(float(rotations.wrap_angle(math.atan2(step[0], step[1]) - command.heading)))
    found["steady_speed_mps"] = float(np.linalg.norm(step))
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


def list_misses(commands: Sequence[Mapping[str, Any]], arrivals: Sequence[Mapping[str, Any]] = ()) -> list[str]:
    """List what was not obeyed of the rows of `measure_commands` and `measure_arrivals`, a sentence with numbers for
    each field. Commands without a steady part are not judged, and no style is."""
    found = [(row["time_s"], miss) for row in commands for miss in _find_misses(row)]
    found += [(row["by_s"], miss) for row in arrivals for miss in _compare(row, _ARRIVAL_LIMITS)]
    return [f"at {seconds:.1f} s: {miss}" for seconds, miss in found]


def _find_misses(row: Mapping[str, Any]) -> Iterator[str]:
    if row["steady_speed_mps"] is None:
        return
    speed, turn, step = row["speed_mps"], row["turn_deg_s"] or 0.0, row["step_m"] or 0.0
    near_speed, near_facing = _find_limits(speed)
    limits = (
        ("steady_speed_mps", speed, near_speed, "speed {:.2f} of {:.2f} m/s"),
        ("steady_heading_error_deg", 0.0, _NEAR_DEG, "heading {:.0f} degrees off"),
        ("steady_facing_error_deg", 0.0, near_facing, "facing {:.0f} degrees off"),
        ("steady_turn_deg_s", turn, max(_NEAR_SHARE * abs(turn), _NEAR_DEG), "turning {:.0f} of {:.0f} degrees/s"),
        ("steady_step_m", step, _NEAR_SHARE * step, "steps of {:.2f} instead of {:.2f} m"),
        ("leftHand_nearest_cm", 0.0, 100 * _HELD_DISTANCE, "left hand {:.0f} cm short"),
        ("rightHand_nearest_cm", 0.0, 100 * _HELD_DISTANCE, "right hand {:.0f} cm short"),
        ("look_nearest_deg", 0.0, _NEAR_FACING_DEG, "head {:.0f} degrees off what it looks at"),
    )
    yield from _compare(row, limits)
    if row.get("clearance_cm", 0.0) < 0:
        yield f"a joint {-row['clearance_cm']:.0f} cm within an obstacle"
    flight = row["steady_flight_share"]
    if row["gait"] is not None and speed > 0 and (row["gait"] == "run") != (flight > RUN_FLIGHT):
        yield f"gait {row['gait']}: no foot on the ground for {flight:.0%} of the time"


def _compare(row: Mapping[str, Any], limits: Sequence[tuple[str, float, float, str]]) -> Iterator[str]:
    """Yield the text of each key, wanted value and largest error whose value in the row is farther off."""
    for key, wanted, most, text in limits:
        if (value := row.get(key)) is not None and abs(value - wanted) > most:
            yield text.format(abs(value) if wanted == 0 else value, wanted)
