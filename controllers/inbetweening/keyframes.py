"""Keyframes of in-betweening: what they leave missing, their effector targets, and the errors of a motion at them.

Poses that look as drawn from one side: rotations of joints about a proposed pose, fitted so that drawn joints come
to be where they are drawn.

How large a drawing is shows in its bones, none of which looks longer than it is; which way a limb leads from the viewer
or to him does not show, and is as the proposed pose has it.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mapctl import joint_ranges, rotations
from mapctl.errors import RequestError
from mapctl.inbetweening.effector_targets import EffectorTargets, LooseKeys, estimate_size, measure_floor, view_axes
from mapctl.inbetweening.missing import MissingMask
from mapctl.intent.keyframes import Drawing, Key, Keys
from mapctl.joint_names import classify_joint, describe_nearest, find_joint
from mapctl.kinematics import forward_kinematics, heading
from mapctl.motion import Motion
from mapctl.retarget import RigMap, as_rig, identify_rig, rig_joint_positions, to_canonical
from mapctl.retarget.rigs import Rig
from mapctl.skeleton import CANONICAL, LIMBS, Skeleton
from mapctl.solver import lbfgs
from mapctl.solver.lbfgs import LbfgsSettings

_SIGMA_DRAWN = 0.005  # metres of a joint from where it is drawn
_SIGMA_POSE_DEG, _SIGMA_TILT_DEG = 25.0, 15.0  # degrees of a joint's turn, and the hips' tilt, from the proposed pose
_SIGMA_RANGE_DEG = 3.0  # degrees of a joint's turn beyond its range
_SIGMA_SIZE = 0.03  # share by which a drawing is larger than its bones let it be
_TURNS = 8  # headings, evenly around, from which the search sets out
_SIGMA_HEADING_DEG = 45.0  # degrees from the proposed heading, by which an answer is chosen where keys tell a heading
_SEARCH = LbfgsSettings(max_iterations=80, relative_energy_tolerance=1e-5)


def fit_drawings(motion: Motion, loose: LooseKeys, *, faced: bool) -> Motion:
    """Turn the joints of a canonical motion, in frames with drawings, until they look as drawn; `faced` says whether
    its headings are more than a guess. The lower foot then stands on the floor."""
    frames = loose.drawings.nonzero()[:, 0]
    root, quats = motion.root_position.clone(), motion.local_quat_xyzw.clone()
    for frame in frames.tolist():
        fitted = _fit(motion.skeleton, quats[frame], _View.of(loose, frame, motion.skeleton), faced)
        quats[frame] = fitted
        root[frame, 1] = -measure_floor(_place_joints(motion.skeleton, fitted)[:, 1], motion.skeleton)
    return replace(motion, root_position=root, local_quat_xyzw=quats)


def measure_drawing_error(places: Float[Tensor, "joints 3"], loose: LooseKeys, frame: int) -> float:
    """Measure how far drawn joints are on average from where they are drawn, metres, the drawing moved and scaled to
    the best fit, and all as large as the body is in space: one that folds up to look small is no nearer for it."""
    drawn = loose.drawn[frame]
    seen = places[drawn].double() @ view_axes(loose.view[frame]).double().mT
    sketch = loose.sketch[frame, drawn].double()
    seen, sketch = seen - seen.mean(dim=0), sketch - sketch.mean(dim=0)
    scale = (seen * sketch).sum() / sketch.square().sum().clamp_min(1e-12)
    body = places[drawn].double()
    size = (body - body.mean(dim=0)).norm() / seen.norm().clamp_min(1e-12)
    return float(size * (seen - scale * sketch).norm(dim=-1).mean())


@dataclass(frozen=True, eq=False)
class _View:
    """One drawing, as it is fitted."""

    joints: list[int]
    """Canonical joints that are drawn."""
    target: Float[Tensor, "drawn 2"]
    """Where, about their mean, metres by the estimated size."""
    axes: Float[Tensor, "2 3"]
    """Directions to the right and up."""

    @staticmethod
    def of(loose: LooseKeys, frame: int, skeleton: Skeleton) -> "_View":
        joints = loose.drawn[frame].nonzero()[:, 0].tolist()
        sketch = loose.sketch[frame, joints].double()
        target = estimate_size(sketch, joints, skeleton) * sketch
        return _View(joints, target - target.mean(dim=0), view_axes(loose.view[frame]).double())


def _fit(skeleton: Skeleton, made: Float[Tensor, "joints 4"], view: _View, faced: bool) -> Float[Tensor, "joints 4"]:
    """Fit one pose, from several headings at once, and return the best."""
    count, joints = _TURNS, len(made)
    turns = torch.arange(count, dtype=made.dtype) * (2 * math.pi / count)
    start = made.expand(count, -1, -1).clone()
    start[:, 0] = rotations.multiply(rotations.about_y(turns), start[:, 0])
    unknowns = torch.zeros(count, 3 * joints + 1, dtype=made.dtype)
    ranges = joint_ranges.load()
    own = ranges.find_excess(ranges.to_angles(rotations.to_matrix(made[1:])))

    def energies(rows: Tensor) -> Tensor:
        turn, size = rows[:, :-1].unflatten(1, (joints, 3)), rows[:, -1]
        quats = rotations.multiply(start, rotations.from_rotation_vector(turn))
        seen = _place_joints(skeleton, quats)[:, view.joints] @ view.axes.mT
        off = seen - seen.mean(dim=1, keepdim=True) - (_SIGMA_SIZE * size).exp()[:, None, None] * view.target
        angles = ranges.to_angles(rotations.to_matrix(quats[:, 1:]))
        beyond = (ranges.find_excess(angles) - own).clamp_min(0)
        return 0.5 * (
            (off / _SIGMA_DRAWN).square().sum(dim=(1, 2))
            + (torch.rad2deg(turn[:, 1:]) / _SIGMA_POSE_DEG).square().sum(dim=(1, 2))
            + (_tilt_deg(start[:, 0], quats[:, 0]) / _SIGMA_TILT_DEG).square()
            + (torch.rad2deg(beyond) / _SIGMA_RANGE_DEG).square().sum(dim=(1, 2))
            + size.square()
        )

    found = lbfgs.minimise(lbfgs.differentiate(energies), unknowns, settings=_SEARCH)
    turn = found.x[:, :-1].unflatten(1, (joints, 3))
    quats = rotations.multiply(start, rotations.from_rotation_vector(turn))
    away = torch.rad2deg(rotations.wrap_angle(heading(quats[:, 0]) - heading(made[:1])))
    energy = found.energy + (0.5 * (away / _SIGMA_HEADING_DEG).square() if faced else 0.0)
    return quats[int(energy.argmin())]


def _place_joints(skeleton: Skeleton, quats: Float[Tensor, "*batch joints 4"]) -> Float[Tensor, "*batch joints 3"]:
    """Place joints about the hips."""
    root = torch.zeros(*quats.shape[:-2], 3, dtype=quats.dtype)
    return forward_kinematics(skeleton.offsets.to(quats), skeleton.parents, root, quats)[0]


def _tilt_deg(one: Float[Tensor, "batch 4"], other: Float[Tensor, "batch 4"]) -> Float[Tensor, " batch"]:
    """Return by how much the body's axis leans otherwise, as a chord, degrees."""
    up = one.new_tensor([0.0, 1.0, 0.0]).expand(len(one), 3)
    # The vertical in the frame of the hips: their lean without their heading.
    lean = rotations.rotate(rotations.inverse(one), up) - rotations.rotate(rotations.inverse(other), up)
    return torch.rad2deg((lean.square().sum(dim=-1) + 1e-12).sqrt())


def missing_between_keys(keys: Sequence[Key], motion: Motion, rigmap: RigMap) -> MissingMask:
    """Return the mask of all values of a motion that keys do not give."""
    free = torch.ones(motion.num_frames, dtype=torch.bool)
    free[[key.frame for key in keys if key.what == "pose"]] = False
    joints, root = free[:, None].expand(-1, motion.num_joints).clone(), free.clone()
    carries_hips = torch.tensor([_carries_hips(joint, rigmap) for joint in range(motion.num_joints)])
    for key in keys:
        if key.what in ("root", "half"):
            root[key.frame] = False
            joints[key.frame] = ~carries_hips
        if key.half is not None:
            joints[key.frame] &= ~_find_half(key.half, rigmap)
    return MissingMask(joints, root)


def collect_effector_targets(keys: Sequence[Key], motion: Motion, rigmap: RigMap) -> EffectorTargets | None:
    """Collect the targets of keys that give only positions of hands and feet; None where no key does. RequestError for
    joints that are neither."""
    if all(key.what != "limbs" for key in keys):
        return None
    wanted = torch.zeros(motion.num_frames, CANONICAL.num_joints, dtype=torch.bool)
    positions, own = torch.zeros(*wanted.shape, 3, dtype=torch.float64), rig_joint_positions(motion, rigmap)
    for key in keys:
        for name in key.ends:
            limb = effector_joint(name, rigmap)
            wanted[key.frame, limb] = True
            given = key.places.get(name)
            positions[key.frame, limb] = own[key.frame, limb] if given is None else own.new_tensor(given)
    return EffectorTargets(positions, wanted)


def collect_loose_keys(keys: Sequence[Key], motion: Motion, rigmap: RigMap) -> LooseKeys | None:
    """Collect places over the ground and drawings of keys; None where no key tells either. RequestError for drawn
    joints that the rig has not, or has twice."""
    if all(key.what not in ("place", "drawing") for key in keys):
        return None
    loose, hips = LooseKeys.none(motion.num_frames, CANONICAL.num_joints), rig_joint_positions(motion, rigmap)[:, 0]
    for key in keys:
        if key.what == "place" or key.placed:
            loose.placed[key.frame] = True
            loose.ground[key.frame] = hips[key.frame, ::2]
        if key.drawing is not None:
            loose.view[key.frame] = math.radians(key.drawing.view_deg)
            for joint, place in resolve_drawing(key.drawing, rigmap).items():
                loose.drawn[key.frame, joint] = True
                loose.sketch[key.frame, joint] = loose.sketch.new_tensor(place)
    return loose


def resolve_drawing(drawing: Drawing, rigmap: RigMap) -> dict[int, tuple[float, float]]:
    """Return the places of a drawing by canonical joint; RequestError, with the nearest name, for a joint that is none
    of these, or that is drawn twice."""
    found: dict[int, tuple[float, float]] = {}
    own = {joint: CANONICAL.index(name) for name, joint in rigmap.joints.items()}
    for name, place in drawing.places_xy.items():
        joint = CANONICAL.names.index(name) if name in CANONICAL.names else None
        if joint is None:
            there = find_joint(name, rigmap.rig_skeleton.names, lambda: rigmap.joints)
            joint = None if there is None else own.get(there)
        if joint is None:
            names = [*rigmap.joint_names.values()]
            nearest = describe_nearest(name, names, [classify_joint(c) for c in rigmap.joint_names])
            raise RequestError(f"no joint {name!r} that could be drawn; {nearest}")
        if joint in found:
            raise RequestError(f"{name!r} is drawn twice, by its own name and by the canonical one")
        found[joint] = place
    return found


def keyframe_errors(made: Motion, source: Motion, keys: Keys, rigmap: RigMap) -> list[dict[str, Any]]:
    """Compute by key the largest error over joints: of positions, cm, and of rotations, degrees, where it gives any."""
    wanted, hips = keys.checked(source), rigmap.joint_of[0]
    distance = 100 * (made.joint_positions() - source.joint_positions()).norm(dim=-1)
    rotation = rotations.multiply(rotations.inverse(source.joint_rotations()), made.joint_rotations())
    angles = torch.rad2deg(rotations.to_rotation_vector(rotation).norm(dim=-1))
    targets = collect_effector_targets(wanted, source, rigmap)
    loose = collect_loose_keys(wanted, source, rigmap)
    known = ~missing_between_keys(wanted, source, rigmap).joints
    rows, places = [], rig_joint_positions(made, rigmap)
    # A drawing may have joints that are no more than an End Site on the rig.
    seen = places if loose is None else to_canonical(made, as_rig(rigmap))[0].joint_positions()
    for key in wanted:
        row: dict[str, Any] = {"frame": key.frame, "what": key.what}
        if key.what == "limbs" and targets is not None:
            miss = (places[key.frame] - targets.places[key.frame]).norm(dim=-1)
            rows.append(row | {"missed_cm": 100 * float(miss[targets.wanted[key.frame]].max())})
            continue
        if loose is not None and key.what in ("place", "drawing"):
            rows.append(row | _compute_loose_errors(seen[key.frame], loose, key.frame))
            continue
        joints = [hips or 0] if key.what == "root" else known[key.frame].nonzero()[:, 0].tolist()
        row |= {"missed_cm": float(distance[key.frame, joints].max())}
        rows.append(row | {"missed_deg": float(angles[key.frame, joints].max())})
    return rows


def _compute_loose_errors(places: Float[Tensor, "joints 3"], loose: LooseKeys, frame: int) -> dict[str, float]:
    """Compute by how much the hips miss their place over the ground, and joints on average where they are drawn."""
    row: dict[str, float] = {}
    if bool(loose.placed[frame]):
        row["missed_cm"] = 100 * float((places[0, ::2] - loose.ground[frame]).norm())
    if bool(loose.drawn[frame].any()):
        row["drawn_cm"] = 100 * measure_drawing_error(places, loose, frame)
    return row


def check_effectors(names: Sequence[str], motion: Motion, rig: Rig | None = None) -> None:
    """Raise RequestError for a name that is no hand or foot of the motion's rig."""
    rigmap = identify_rig(motion.skeleton, rig, motion=motion)
    for name in names:
        effector_joint(name, rigmap)


def effector_joint(name: str, rigmap: RigMap) -> int:
    """Find the canonical joint of an effector, by its canonical name or the rig's own in any case; RequestError, with
    the nearest name, for anything else."""
    names = rigmap.rig_skeleton.names
    known = {c: joint for c, joint in zip(CANONICAL.names, rigmap.joint_of, strict=True) if joint is not None}
    ends = {known[end]: CANONICAL.index(end) for end in LIMBS if end in known}
    joint = find_joint(name, names, lambda: known)
    if joint in ends:
        return ends[joint]
    given = [classify_joint(CANONICAL.names[end]) for end in ends.values()]
    raise RequestError(f"no hand or foot {name!r}; {describe_nearest(name, [names[end] for end in ends], given)}")


def _find_half(half: str, rigmap: RigMap) -> Bool[Tensor, " joints"]:
    """Find the joints of a rig that belong to a half of the body. Those that no canonical joint is belong to that which
    the nearest one below them does, or else above; the upper half has what hangs on the hips besides."""
    parents = rigmap.rig_skeleton.parents
    legs = {joint: _is_leg(name) for name, joint in rigmap.joints.items() if name != CANONICAL.names[0]}
    for joint in reversed(range(len(parents))):  # upwards, from what hangs below
        if joint in legs and parents[joint] >= 0 and parents[joint] != rigmap.joint_of[0]:
            legs.setdefault(parents[joint], legs[joint])
    for joint, parent in enumerate(parents):
        legs.setdefault(joint, legs.get(parent, False) if parent != rigmap.joint_of[0] else False)
    return torch.tensor([legs[joint] == (half == "lower") for joint in range(len(parents))])


def _is_leg(name: str) -> bool:
    return name.endswith(("Leg", "Foot", "Toes"))


def _carries_hips(joint: int, rigmap: RigMap) -> bool:
    """Return whether a joint of the rig is the hips or an ancestor of theirs."""
    own: int | None = rigmap.joint_of[0]
    parents: Sequence[int] = rigmap.rig_skeleton.parents
    while own is not None and own >= 0:
        if own == joint:
            return True
        own = parents[own]
    return False
