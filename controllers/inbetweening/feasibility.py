"""Keyframes that nobody could reach in time, named with numbers before the solve."""

from itertools import pairwise

import torch
from jaxtyping import Float
from torch import Tensor

from mapctl import rotations
from mapctl.inbetweening.effector_targets import EffectorTargets
from mapctl.inbetweening.missing import MissingMask
from mapctl.motion import Motion
from mapctl.retarget import RigMap, rig_joint_positions

_MAX_ROOT_SPEED = 10.0  # m/s of the hips


_MAX_JOINT_RATE = 30.0  # rad/s of a joint


_MAX_EFFECTOR_SPEED = 25.0  # m/s of a hand or a foot: beyond what kicks and throws reach


_MAX_EFFECTOR_ACCELERATION = 130.0
"""m/s^2 of a hand, seen from the hips: one frame in a thousand of mocap's (walks to fights) has more."""


MIN_JERK_PEAK_ACCELERATION = 5.77
"""Peak acceleration of the smoothest way, of least jerk, over distance and time squared (Flash and Hogan 1985)."""


def check_keyframes(
    motion: Motion, canonical: Motion, rigmap: RigMap, lost: MissingMask, targets: EffectorTargets | None
) -> tuple[str, ...]:
    """Sentences about neighbouring keys that even the shortest way between them is too fast for: by place of the hips
    (metres), by rotation of the joints that both of them tell, or by places that hands and feet are to reach.

    The motion is right where something is known, on its rig and on canonical joints.
    """
    notes, hips = [], canonical.root_position
    for start, stop in pairwise((~lost.root).nonzero()[:, 0].tolist()):
        seconds = float((stop - start) / motion.fps)
        speed = float((hips[stop] - hips[start]).norm()) / seconds
        if speed > _MAX_ROOT_SPEED:
            notes.append(f"the hips need {speed:.1f} m/s between frames {start} and {stop}, which nobody runs")
        quats = motion.local_quat_xyzw[[start, stop]]
        turns = rotations.to_rotation_vector(rotations.multiply(rotations.inverse(quats[0]), quats[1])).norm(dim=-1)
        rates = turns * ~(lost.joints[start] | lost.joints[stop]) / seconds
        worst = int(rates.argmax())
        if float(rates[worst]) > _MAX_JOINT_RATE:
            notes.append(
                f"{motion.skeleton.names[worst]} needs {float(rates[worst]):.0f} rad/s between frames {start} "
                f"and {stop}, which nobody turns"
            )
    return (*notes, *([] if targets is None else _check_effector_targets(motion, hips, rigmap, lost, targets)))


def _check_effector_targets(
    motion: Motion, hips: Float[Tensor, "frames 3"], rigmap: RigMap, lost: MissingMask, targets: EffectorTargets
) -> list[str]:
    """Of hands and feet whose place is all that one of two neighbouring keys tells."""
    notes, whole, own = [], ~lost.frames, rig_joint_positions(motion, rigmap)
    for limb in targets.wanted.any(dim=0).nonzero()[:, 0].tolist():
        wanted = targets.wanted[:, limb]
        places = torch.where(wanted[:, None], targets.places[:, limb], own[:, limb])
        for start, stop in pairwise((wanted | whole).nonzero()[:, 0].tolist()):
            if not bool(wanted[start] | wanted[stop]):
                continue
            way, seconds = places[stop] - places[start], (stop - start) / float(motion.fps)
            speed, name = float(way.norm()) / seconds, motion.skeleton.names[rigmap.joint_of[limb] or 0]
            far = float((way - (hips[stop] - hips[start])).norm())
            jolt = MIN_JERK_PEAK_ACCELERATION * far / seconds**2
            if speed > _MAX_EFFECTOR_SPEED:
                notes.append(f"{name} needs {speed:.0f} m/s between frames {start} and {stop}, which nobody reaches")
            elif jolt > _MAX_EFFECTOR_ACCELERATION:
                where = f"between frames {start} and {stop}"
                notes.append(
                    f"{name} goes {100 * far:.0f} cm in {seconds:.2f} s {where}, which takes {jolt:.0f} m/s^2;"
                    f" mocap's hardly ever reach {_MAX_EFFECTOR_ACCELERATION:.0f}"
                )
    return notes
