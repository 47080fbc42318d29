"""Wishes that cannot hold, named with numbers: before the solve from the data, after it from what was missed."""

from itertools import pairwise

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mapctl import rotations
from mapctl.curves import Curve
from mapctl.features import PRIOR_FPS
from mapctl.inbetweening.effector_targets import Targets
from mapctl.inbetweening.missing import Lost
from mapctl.intent.path import Follow
from mapctl.motion import Motion
from mapctl.protocols import Abilities
from mapctl.retarget import RigMap, places_on_rig

_TOLERATED_CM = 15.0
_OVERSHOOT = 0.15  # metres: the last frame of a walk may lie a step of one frame beyond the end
_CORNER_SECONDS = 1.0
_SPRINT = 10.0  # m/s of the hips
_WHIP = 30.0  # rad/s of a joint
_FLING = 25.0  # m/s of a hand or a foot: beyond what kicks and throws reach
_JOLT = 130.0
"""m/s^2 of a hand, seen from the hips: one frame in a thousand of mocap's (walks to fights) has more."""
JERKLESS = 5.77
"""Peak acceleration of the smoothest way, of least jerk, over distance and time squared (Flash and Hogan 1985)."""


def in_advance(request: Follow, arcs: Float[Tensor, " frames"], abilities: Abilities) -> list[str]:
    """Sentences about speeds and corners beyond the prior's data, and about a curve that ends too soon."""
    notes = []
    speeds = torch.diff(arcs) * PRIOR_FPS
    fastest, slowest = round(float(speeds.max()), 3), round(float(speeds.min()), 3)
    if fastest > abilities.fastest:
        notes.append(f"{fastest:.2f} m/s is faster than the prior's data, which reach {abilities.fastest:.2f} m/s")
    if slowest < abilities.slowest:
        notes.append(f"{slowest:.2f} m/s is slower than the prior's data, which begin at {abilities.slowest:.2f} m/s")
    notes += _corners(request, arcs, abilities)
    if not request.curve.closed and float(arcs[-1]) > request.curve.length + _OVERSHOOT:
        over = float(arcs[-1]) - request.curve.length
        notes.append(
            f"the last {over:.1f} m go straight on beyond the end of the curve of {request.curve.length:.1f} m"
        )
    return notes


def after_the_fact(motion: Motion, curve: Curve, joint: str) -> list[str]:
    """The stretch around the worst frame that leaves the curve by more than 15 cm, if there is one."""
    walked = motion.joint_positions()[:, motion.skeleton.index(joint)]
    places = walked[:, ::2] if curve.dims == 2 else walked
    error = (places - curve.point(curve.track(walked, start=0.0))).norm(dim=-1)
    if float(error.max()) * 100 <= _TOLERATED_CM:
        return []
    first, last = (float(frame / motion.fps) for frame in _stretch(error * 100 > _TOLERATED_CM, int(error.argmax())))
    return [f"the curve is left by up to {100 * float(error.max()):.0f} cm between {first:.1f} and {last:.1f} s"]


def between_keys(
    motion: Motion, canonical: Motion, rigmap: RigMap, lost: Lost, targets: Targets | None
) -> tuple[str, ...]:
    """Sentences about neighbouring keys that even the shortest way between them is too fast for: by place of the hips
    (metres), by rotation of the joints that both of them tell, or by places that hands and feet are to reach.

    The motion is right where something is known, on its rig and on canonical joints.
    """
    notes, hips = [], canonical.root_position
    for start, stop in pairwise((~lost.root).nonzero()[:, 0].tolist()):
        seconds = float((stop - start) / motion.fps)
        speed = float((hips[stop] - hips[start]).norm()) / seconds
        if speed > _SPRINT:
            notes.append(f"the hips need {speed:.1f} m/s between frames {start} and {stop}, which nobody runs")
        quats = motion.local_quat_xyzw[[start, stop]]
        turns = rotations.to_rotation_vector(rotations.multiply(rotations.inverse(quats[0]), quats[1])).norm(dim=-1)
        rates = turns * ~(lost.joints[start] | lost.joints[stop]) / seconds
        worst = int(rates.argmax())
        if float(rates[worst]) > _WHIP:
            notes.append(
                f"{motion.skeleton.names[worst]} needs {float(rates[worst]):.0f} rad/s between frames {start} "
                f"and {stop}, which nobody turns"
            )
    return (*notes, *([] if targets is None else _limbs(motion, hips, rigmap, lost, targets)))


def _limbs(motion: Motion, hips: Float[Tensor, "frames 3"], rigmap: RigMap, lost: Lost, targets: Targets) -> list[str]:
    """Of hands and feet whose place is all that one of two neighbouring keys tells."""
    notes, whole, own = [], ~lost.frames, places_on_rig(motion, rigmap)
    for limb in targets.wanted.any(dim=0).nonzero()[:, 0].tolist():
        wanted = targets.wanted[:, limb]
        places = torch.where(wanted[:, None], targets.places[:, limb], own[:, limb])
        for start, stop in pairwise((wanted | whole).nonzero()[:, 0].tolist()):
            if not bool(wanted[start] | wanted[stop]):
                continue
            way, seconds = places[stop] - places[start], (stop - start) / float(motion.fps)
            speed, name = float(way.norm()) / seconds, motion.skeleton.names[rigmap.joint_of[limb] or 0]
            far = float((way - (hips[stop] - hips[start])).norm())
            jolt = JERKLESS * far / seconds**2
            if speed > _FLING:
                notes.append(f"{name} needs {speed:.0f} m/s between frames {start} and {stop}, which nobody reaches")
            elif jolt > _JOLT:
                where = f"between frames {start} and {stop}"
                notes.append(
                    f"{name} goes {100 * far:.0f} cm in {seconds:.2f} s {where}, which takes {jolt:.0f} m/s^2;"
                    f" mocap's hardly ever reach {_JOLT:.0f}"
                )
    return notes


def _stretch(off: Bool[Tensor, " frames"], worst: int) -> tuple[int, int]:
    """First and last frame of the unbroken stretch around the worst one."""
    inside = (~off).nonzero()[:, 0]
    before, after = inside[inside < worst], inside[inside > worst]
    return int(before[-1]) + 1 if len(before) else 0, int(after[0]) - 1 if len(after) else len(off) - 1


def _corners(request: Follow, arcs: Tensor, abilities: Abilities) -> list[str]:
    """The sharpest turn over one second of the walk (or all of a shorter one), if it is beyond the data."""
    step = min(round(_CORNER_SECONDS * PRIOR_FPS), len(arcs) - 1)
    samples = request.curve.curvature(arcs) * torch.gradient(arcs)[0]
    turned = torch.nn.functional.pad(samples.cumsum(0), (1, 0))
    turned = (turned[step:] - turned[:-step]).abs()
    worst = int(turned.argmax())
    if float(turned[worst]) <= abilities.turn_rate:
        return []
    degrees, able = (torch.rad2deg(torch.tensor(v)).item() for v in (float(turned[worst]), abilities.turn_rate))
    return [
        f"the curve turns {degrees:.0f} degrees within a second at {float(arcs[worst]):.1f} m, "
        f"where the prior's data turn at most {able:.0f}"
    ]
