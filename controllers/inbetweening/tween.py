"""In-betweening of keyframes. What a key gives is no unknown, so it is met to the bit; where it gives only the position
of a hand or a foot, the limb is bent to reach it."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import pairwise
from typing import Any, Unpack

import torch
from jaxtyping import Bool
from torch import Tensor

from controllers.inbetweening.keyframes import (
    collect_effector_targets,
    collect_loose_keys,
    measure_drawing_error,
    missing_between_keys,
)
from controllers.inbetweening.on_ground import KeysOnGround
from controllers.inbetweening.pipeline import FillOptions, InbetweenSolution, fill
from mapctl import joint_ranges, rotations
from mapctl.ground import Ground
from mapctl.inbetweening.effector_targets import EffectorTargets, LooseKeys
from mapctl.inbetweening.missing import interpolate_missing
from mapctl.intent.keyframes import Key, Keys
from mapctl.motion import Motion
from mapctl.protocols import Inbetweener
from mapctl.recording.masks import MissingMask
from mapctl.retarget import RigMap, as_rig, identify_rig, rig_joint_positions, to_canonical
from mapctl.retarget.rigs import Rig

_MAX_ROOT_SPEED = 10.0  # m/s of the hips
_MAX_JOINT_RATE = 30.0  # rad/s of a joint
_MAX_EFFECTOR_SPEED = 25.0  # m/s of a hand or a foot: beyond kicks and throws
_MAX_EFFECTOR_ACCELERATION = 130.0
"""m/s^2 of a hand relative to the hips: one frame in a thousand of mocap's (walks to fights) has more."""
_REPORTED_DEGREES = 1.0  # beyond a joint's range, of which there is a note
_MAX_NOTES = 4  # joints beyond their ranges that are named
MIN_JERK_PEAK_ACCELERATION = 5.77
"""Peak acceleration of the minimum-jerk trajectory, over distance and time squared (Flash and Hogan 1985)."""


def check_keyframes(
    motion: Motion,
    canonical: Motion,
    rigmap: RigMap,
    missing: MissingMask,
    targets: EffectorTargets | None,
    loose: LooseKeys | None = None,
) -> tuple[str, ...]:
    """Note neighbouring keys between which even the shortest path is too fast: by position of the hips (metres), by
    rotation of the joints that both give, or by effector targets. Positions of loose keys count over the ground.

    The motion is valid where it is not missing, on its rig and on canonical joints.
    """
    notes, fps, known, hips = [], float(motion.fps), ~missing.root, canonical.root_position
    placed, positions = torch.zeros_like(known) if loose is None else loose.placed, hips.clone()
    if loose is not None:
        positions[placed, ::2] = loose.ground[placed]
    for start, stop in _pairs(known | placed):
        axes = [0, 2] if bool(placed[start] | placed[stop]) else [0, 1, 2]
        speed = float((positions[stop] - positions[start])[axes].norm()) * fps / (stop - start)
        if speed > _MAX_ROOT_SPEED:
            notes.append(f"the hips need {speed:.1f} m/s between frames {start} and {stop}, faster than anyone runs")
    for start, stop in _pairs(known):
        turns = rotations.turns_between(*motion.local_quat_xyzw[[start, stop]]).norm(dim=-1)
        rates = turns * ~(missing.joints[start] | missing.joints[stop]) * fps / (stop - start)
        worst = int(rates.argmax())
        if (rate := float(rates[worst])) > _MAX_JOINT_RATE:
            name = motion.skeleton.names[worst]
            notes.append(f"{name} needs {rate:.0f} rad/s between frames {start} and {stop}, faster than joints turn")
    if targets is None:
        return tuple(notes)
    whole, own = ~missing.frames, rig_joint_positions(motion, rigmap)
    for limb in targets.wanted.any(dim=0).nonzero()[:, 0].tolist():
        wanted, name = targets.wanted[:, limb], motion.skeleton.names[rigmap.joint_of[limb] or 0]
        ends = torch.where(wanted[:, None], targets.positions[:, limb], own[:, limb])
        for start, stop in _pairs(wanted | whole):
            if not bool(wanted[start] | wanted[stop]):
                continue
            displacement, seconds = ends[stop] - ends[start], (stop - start) / fps
            speed = float(displacement.norm()) / seconds
            distance = float((displacement - (hips[stop] - hips[start])).norm())
            acceleration = MIN_JERK_PEAK_ACCELERATION * distance / seconds**2
            if speed > _MAX_EFFECTOR_SPEED:
                notes.append(f"{name} needs {speed:.0f} m/s between frames {start} and {stop}, faster than limbs move")
            elif acceleration > _MAX_EFFECTOR_ACCELERATION:
                notes.append(
                    f"{name} goes {100 * distance:.0f} cm in {seconds:.2f} s between frames {start} and {stop}, which"
                    f" takes {acceleration:.0f} m/s^2; mocap's hardly ever reach {_MAX_EFFECTOR_ACCELERATION:.0f}"
                )
    return tuple(notes)


def _pairs(keys: Bool[Tensor, " frames"]) -> Iterator[tuple[int, int]]:
    """Return the frames of neighbouring keys."""
    return pairwise(keys.nonzero()[:, 0].tolist())


def note_joint_ranges(canonical: Motion, missing: MissingMask, rigmap: RigMap) -> tuple[str, ...]:
    """Note the joints that keys turn beyond their ranges: they stay as given. The motion is canonical and valid where
    it is not missing; the mask is of the rig's joints."""
    known = torch.zeros(canonical.num_frames, canonical.num_joints, dtype=torch.bool)
    for joint, own in enumerate(rigmap.joint_of):
        above = rigmap.joint_of[canonical.skeleton.parents[joint]] if joint else None
        if own is not None and above is not None:
            known[:, joint] = ~(missing.joints[:, own] | missing.joints[:, above])
    found = joint_ranges.outside(canonical, known=known)
    notes = [
        f"{one.joint} is {one.degrees:.0f} degrees beyond its range in the key at frame {one.frame}, and stays as given"
        for one in found
        if one.degrees > _REPORTED_DEGREES
    ]
    more = [] if len(notes) <= _MAX_NOTES else [f"and {len(notes) - _MAX_NOTES} more joints are beyond their ranges"]
    return (*notes[:_MAX_NOTES], *more)


def tween(
    motion: Motion,
    keys: Keys,
    inbetweener: Inbetweener,
    *,
    ground: Ground | None = None,
    **options: Unpack[FillOptions],
) -> InbetweenSolution:
    """Make a motion of the same length through the keys of a motion, of which all else is ignored.

    RequestError for keys that do not fit the motion or its rig, and for keys on a `ground` that is not flat that are no
    whole poses; keys that no body could meet in time are named in the status, which is then infeasible.
    """
    wanted = keys.checked(motion)
    canonical, rigmap, shown = keyframe_motion(wanted, motion, options.get("rig"))
    if ground is not None:
        standing, options["rig"] = KeysOnGround.of(motion, canonical, wanted, rigmap, ground), as_rig(rigmap)
        done = tween(standing.on_floor(), keys, inbetweener, **options)
        put, footing = standing.put_between(done.motion)
        status = done.status.with_notes(footing.notes, infeasible=bool(footing.notes))
        return replace(done, motion=put, footing=footing, status=status)
    missing, targets = missing_between_keys(wanted, motion, rigmap), collect_effector_targets(wanted, shown, rigmap)
    loose = collect_loose_keys(wanted, motion, rigmap)
    infeasible = check_keyframes(shown, canonical, rigmap, missing, targets, loose)
    options["rig"] = as_rig(rigmap)
    done = fill(motion, missing, inbetweener, targets=targets, loose=loose, **options)
    beyond = note_joint_ranges(canonical, missing, rigmap)
    status = done.status.with_notes(beyond)
    return replace(done, status=status.with_notes(infeasible, infeasible=bool(infeasible)))


def keyframe_motion(wanted: Sequence[Key], motion: Motion, rig: Rig | None) -> tuple[Motion, RigMap, Motion]:
    """Return the keys with an interpolation between them: on canonical joints, with the map of the rig, which is
    identified from these, and on the rig."""
    free = torch.ones(motion.num_frames, dtype=torch.bool)
    # Where keys tell no rotation at all, the rig is known by the pose at any of them.
    free[[key.frame for key in wanted if key.shown] or [wanted[0].frame]] = False
    shown = interpolate_missing(motion, MissingMask.of_frames(free, motion.num_joints))
    canonical, rigmap = to_canonical(shown, rig)
    unseen = missing_between_keys(wanted, motion, rigmap).joints.all(dim=0)
    if rigmap.tpose_doubt and bool(unseen.any()):  # joints that no key gives are no evidence of how the rig is built
        rested = shown.local_quat_xyzw.clone()
        rested[:, unseen] = torch.tensor([0.0, 0.0, 0.0, 1.0], dtype=rested.dtype)
        known = identify_rig(motion.skeleton, rig, motion=replace(shown, local_quat_xyzw=rested))
        canonical, rigmap = to_canonical(shown, known)
    return canonical, rigmap, shown


def measure_keyframe_errors(
    generated: Motion, source: Motion, keys: Keys, rig: Rig | None = None
) -> list[dict[str, Any]]:
    """Measure by key the largest error over joints: of positions, cm, and of rotations, degrees, where it gives any."""
    wanted = keys.checked(source)
    rigmap = keyframe_motion(wanted, source, rig)[1]
    hips = rigmap.joint_of[0]
    distance = 100 * (generated.joint_positions() - source.joint_positions()).norm(dim=-1)
    turns = rotations.turns_between(source.joint_rotations(), generated.joint_rotations())
    angles = torch.rad2deg(turns.norm(dim=-1))
    targets = collect_effector_targets(wanted, source, rigmap)
    loose = collect_loose_keys(wanted, source, rigmap)
    known = ~missing_between_keys(wanted, source, rigmap).joints
    rows, positions = [], rig_joint_positions(generated, rigmap)
    # A drawing may have joints that are no more than an End Site on the rig.
    seen = positions if loose is None else to_canonical(generated, as_rig(rigmap))[0].joint_positions()
    for key in wanted:
        row: dict[str, Any] = {"frame": key.frame, "what": key.what}
        if key.what == "limbs" and targets is not None:
            miss = (positions[key.frame] - targets.positions[key.frame]).norm(dim=-1)
            rows.append(row | {"missed_cm": 100 * float(miss[targets.wanted[key.frame]].max())})
            continue
        if loose is not None and key.what in ("place", "drawing"):
            position = seen[key.frame]
            if bool(loose.placed[key.frame]):
                row["missed_cm"] = 100 * float((position[0, ::2] - loose.ground[key.frame]).norm())
            if key.drawing is not None:
                row["drawn_cm"] = 100 * measure_drawing_error(position, loose, key.frame)
            rows.append(row)
            continue
        joints = [hips or 0] if key.what == "root" else known[key.frame].nonzero()[:, 0].tolist()
        row |= {"missed_cm": float(distance[key.frame, joints].max())}
        rows.append(row | {"missed_deg": float(angles[key.frame, joints].max())})
    return rows
