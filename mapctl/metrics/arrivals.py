"""How near a character came to where it was ordered to be, and when."""

import math
from collections.abc import Sequence

from mapctl import rotations
from mapctl.intent.steering import Arrival, CommandTrack
from mapctl.kinematics import heading
from mapctl.motion import Motion


def measure_arrivals(
    motion: Motion, track: CommandTrack, refused: Sequence[Arrival] = ()
) -> list[dict[str, float | int | None]]:
    """Measure a row for each order of a track whose time is within a canonical motion, but for those refused.

    Keys: `ordered_s` and `by_s`, seconds; `goto_x_m`, `goto_z_m` and `goto_facing_deg` (None where none was wanted);
    `frame`, on which it was to be there; `place_error_cm` and `facing_error_deg` of the hips on that frame;
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
                "goto_x_m": order.place[0],
                "goto_z_m": order.place[1],
                "goto_facing_deg": None if order.facing is None else math.degrees(order.facing),
                "frame": frame,
                "place_error_cm": 100 * math.dist((x, z), order.place),
                "facing_error_deg": off,
                "pose_error_cm": _measure_pose(motion.slice(frame, frame + 1), order),
            }
        )
    return rows


def _measure_pose(found: Motion, order: Arrival) -> float | None:
    if order.pose is None:
        return None
    places = []
    for one in (found, order.pose):
        turn = rotations.about_y(-heading(one.local_quat_xyzw[:, 0]))[:, None]
        joints = one.joint_positions()
        places.append(rotations.rotate(turn.expand(1, joints.shape[1], 4), joints - joints[:, :1]))
    scale = float(places[0].norm(dim=-1).mean() / places[1].norm(dim=-1).mean())
    return 100 * float((places[0] - scale * places[1]).norm(dim=-1).mean())
