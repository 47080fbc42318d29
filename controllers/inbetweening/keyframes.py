"""Keyframes: key files as poses on one body, what keys leave missing, effector targets, drawings, and errors.

A drawn pose is fitted by rotations of joints about a proposed pose, so that drawn joints come to where they are drawn.
The size of a drawing follows from its bones, none of which looks longer than it is; whether a limb leads towards or
away from the viewer is as the proposed pose has it.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from fractions import Fraction
from functools import reduce
from itertools import pairwise
from pathlib import Path
from typing import Any, Literal

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mapctl import formats, joint_ranges, rotations
from mapctl.errors import MapctlError, RequestError
from mapctl.inbetweening.effector_targets import EffectorTargets, LooseKeys, estimate_size, measure_floor, view_axes
from mapctl.inbetweening.missing import interpolate_missing
from mapctl.inbetweening.pose_pairs import (
    TRAVELLING_DISTANCE,
    compute_pair_features,
    compute_pose_distance,
    compute_travel_distance,
)
from mapctl.intent.keyframes import Drawing, Key, KeyEntry, KeyRequest, Keys, read_drawing
from mapctl.joint_names import classify_joint, describe_nearest, find_joint
from mapctl.kinematics import forward_kinematics, heading
from mapctl.motion import Motion, join_licences
from mapctl.recording.masks import MissingMask
from mapctl.retarget import RigMap, as_rig, from_canonical, rig_joint_positions, to_canonical
from mapctl.retarget.carry import RiggedCharacter, retarget_motion
from mapctl.retarget.rigs import Rig
from mapctl.skeleton import CANONICAL, LIMBS, Skeleton, leg_length
from mapctl.solver import lbfgs
from mapctl.solver.lbfgs import LbfgsSettings

_SIGMA_DRAWN = 0.005  # metres of a joint from where it is drawn
_SIGMA_POSE_DEG, _SIGMA_TILT_DEG = 25.0, 15.0  # degrees of a joint's turn, and the hips' tilt, from the proposed pose
_SIGMA_RANGE_DEG = 3.0  # degrees of a joint's turn beyond its range
_SIGMA_SIZE = 0.03  # share by which a drawing is larger than its bones let it be
_TURNS = 8  # headings, evenly around, from which the search sets out
_SIGMA_HEADING_DEG = 45.0  # degrees from the proposed heading, by which an answer is chosen where keys tell a heading
_SEARCH = LbfgsSettings(max_iterations=160, relative_energy_tolerance=1e-5)


def fit_drawings(motion: Motion, loose: LooseKeys, *, faced: bool) -> Motion:
    """Turn the joints of a canonical motion, in frames with drawings, until they look as drawn; `faced` is whether
    its headings are more than a guess. The lower foot then stands on the floor."""
    root, quats, skeleton = motion.root_position.clone(), motion.local_quat_xyzw.clone(), motion.skeleton
    for frame in loose.drawings.nonzero()[:, 0].tolist():
        joints = loose.drawn[frame].nonzero()[:, 0].tolist()
        sketch = loose.sketch[frame, joints].double()
        target = estimate_size(sketch, joints, skeleton) * sketch
        axes = view_axes(loose.view[frame]).double()
        quats[frame] = _fit(skeleton, quats[frame], joints, target - target.mean(dim=0), axes, faced)
        root[frame, 1] = -measure_floor(_place_joints(skeleton, quats[frame])[:, 1], skeleton)
    return replace(motion, root_position=root, local_quat_xyzw=quats)


def measure_drawing_error(positions: Float[Tensor, "joints 3"], loose: LooseKeys, frame: int) -> float:
    """Measure how far drawn joints are on average from where they are drawn, metres, the drawing moved and scaled to
    the best fit, and all as large as the body is in space: one that folds up to look small is no nearer for it."""
    drawn = loose.drawn[frame]
    seen = positions[drawn].double() @ view_axes(loose.view[frame]).double().mT
    sketch = loose.sketch[frame, drawn].double()
    seen, sketch = seen - seen.mean(dim=0), sketch - sketch.mean(dim=0)
    scale = (seen * sketch).sum() / sketch.square().sum().clamp_min(1e-12)
    body = positions[drawn].double()
    size = (body - body.mean(dim=0)).norm() / seen.norm().clamp_min(1e-12)
    return float(size * (seen - scale * sketch).norm(dim=-1).mean())


def _fit(
    skeleton: Skeleton,
    proposed: Float[Tensor, "joints 4"],
    drawn: list[int],
    target: Float[Tensor, "drawn 2"],
    axes: Float[Tensor, "2 3"],
    faced: bool,
) -> Float[Tensor, "joints 4"]:
    """Fit one pose, from several headings at once, and return the best: the drawn joints to their targets about their
    mean, metres, seen along the axes to the right and up."""
    count, joints = _TURNS, len(proposed)
    turns = torch.arange(count, dtype=proposed.dtype) * (2 * math.pi / count)
    start = proposed.expand(count, -1, -1).clone()
    start[:, 0] = rotations.multiply(rotations.about_y(turns), start[:, 0])
    unknowns = torch.zeros(count, 3 * joints + 1, dtype=proposed.dtype)
    ranges = joint_ranges.load()
    own = ranges.find_excess(ranges.to_angles(rotations.to_matrix(proposed[1:])))

    def energies(rows: Tensor) -> Tensor:
        turn, size = rows[:, :-1].unflatten(1, (joints, 3)), rows[:, -1]
        quats = rotations.multiply(start, rotations.from_rotation_vector(turn))
        seen = _place_joints(skeleton, quats)[:, drawn] @ axes.mT
        off = seen - seen.mean(dim=1, keepdim=True) - (_SIGMA_SIZE * size).exp()[:, None, None] * target
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
    away = torch.rad2deg(rotations.wrap_angle(heading(quats[:, 0]) - heading(proposed[:1])))
    energy = energies(found.x) + (0.5 * (away / _SIGMA_HEADING_DEG).square() if faced else 0.0)
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
    carries_hips = torch.zeros(motion.num_joints, dtype=torch.bool)
    own = rigmap.joint_of[0]
    while own is not None and own >= 0:
        carries_hips[own] = True
        own = rigmap.rig_skeleton.parents[own]
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
            given = key.positions.get(name)
            positions[key.frame, limb] = own[key.frame, limb] if given is None else own.new_tensor(given)
    return EffectorTargets(positions, wanted)


def collect_loose_keys(keys: Sequence[Key], motion: Motion, rigmap: RigMap) -> LooseKeys | None:
    """Collect ground positions and drawings of keys; None where no key has either. RequestError for drawn
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
            for joint, position in resolve_drawing(key.drawing, rigmap).items():
                loose.drawn[key.frame, joint] = True
                loose.sketch[key.frame, joint] = loose.sketch.new_tensor(position)
    return loose


def resolve_drawing(drawing: Drawing, rigmap: RigMap) -> dict[int, tuple[float, float]]:
    """Return the positions of a drawing by canonical joint; RequestError, with the nearest name, for a joint that is
    none of these, or that is drawn twice."""
    found: dict[int, tuple[float, float]] = {}
    own = {joint: CANONICAL.index(name) for name, joint in rigmap.joints.items()}
    for name, position in drawing.positions_xy.items():
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
        found[joint] = position
    return found


def effector_joint(name: str, rigmap: RigMap) -> int:
    """Find the canonical joint of an effector, by its canonical name or the rig's own in any case; RequestError, with
    the nearest name, for anything else."""
    names, known = rigmap.rig_skeleton.names, rigmap.joints
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
    legs = {
        joint: name.endswith(("Leg", "Foot", "Toes"))
        for name, joint in rigmap.joints.items()
        if name != CANONICAL.names[0]
    }
    for joint in reversed(range(len(parents))):  # upwards, from what hangs below
        if joint in legs and parents[joint] >= 0 and parents[joint] != rigmap.joint_of[0]:
            legs.setdefault(parents[joint], legs[joint])
    for joint, parent in enumerate(parents):
        legs.setdefault(joint, parent != rigmap.joint_of[0] and legs.get(parent, False))
    return torch.tensor([legs[joint] == (half == "lower") for joint in range(len(parents))])


@dataclass(frozen=True, eq=False)
class KeyframeClip:
    """Motion and keys as `tween` takes them."""

    motion: Motion
    """Motion on the body's rig, at the requested rate: the poses at their keys, interpolated between them."""
    keys: Keys
    """Keys of the motion."""
    rig: Rig | None
    """The body's rig, where it is known."""


def build_keyframe_clip(
    request: KeyRequest, rig: Rig | None = None, on_read: Callable[[Path, Motion, Rig | None], None] | None = None
) -> KeyframeClip:
    """Build the motion and the keys of a request. RequestError, which names the key, for poses and joints that do not
    exist; `rig` is the body's where it is not the one that would be recognised. `on_read` is called with each file that
    is read, its motion and its rig."""
    first = next((number for number, key in enumerate(request.key) if key.pose is not None), 0)
    body_path = request.body or request.key[first].pose or ""
    loaded: dict[str, tuple[Motion, Motion]] = {}  # clips as read, and on canonical joints with the body's bones

    def load(path: str, own_rig: Rig | None) -> Motion:
        clip = formats.load(Path(path), metres_per_unit=None if own_rig is None else own_rig.metres_per_unit)
        if on_read is not None:
            on_read(Path(path), clip, own_rig)
        return clip

    with _prefix_errors("body" if request.body is not None else f"key[{first}].pose"):
        body_clip = load(body_path, rig)
        canonical, body = RiggedCharacter.of(body_clip, rig)
        loaded[body_path] = body_clip, canonical
    fps = Fraction(request.fps).limit_denominator(100_000)
    keys, poses = {}, {}
    for number, key in enumerate(request.key):
        frame = request.frame_of(key)
        keys[frame] = _build_key(key, frame, body.rigmap, number)
        if not (key.needs_pose or key.gives_position):
            continue
        path = key.pose or body_path
        if path not in loaded:
            with _prefix_errors(f"key[{number}].pose"):
                clip = load(path, None)
                loaded[path] = clip, retarget_motion(clip, body).motion
        pose = _build_pose(key, number, *loaded[path], body_clip.skeleton, body.rigmap)
        poses[frame] = replace(pose, fps=fps, source=body_clip.source)
    licence = join_licences(clip.licence for clip, _ in loaded.values())
    motion = replace(_interpolate_poses(poses, max(keys) + 1), licence=licence)
    return KeyframeClip(motion, Keys(tuple(keys.values())), as_rig(body.rigmap))


def _build_key(key: KeyEntry, frame: int, rigmap: RigMap, number: int) -> Key:
    for name, names in (("joints", key.joints), ("reach", tuple(key.reach))):
        with _prefix_errors(f"key[{number}].{name}"):
            for joint in names:
                effector_joint(joint, rigmap)
    drawing = None
    if key.drawing is not None:
        with _prefix_errors(f"key[{number}].drawing"):
            drawing = read_drawing(key.drawing, key.view_deg or 0.0)
            resolve_drawing(drawing, rigmap)
    placed = drawing is not None and key.place is not None
    kind: Literal["place"] | bool = "place" if key.root_only == "place" else bool(key.root_only)
    return Key(frame, key.joints, key.reach, root_only=kind, half=key.half, drawing=drawing, placed=placed)


def _build_pose(
    key: KeyEntry, number: int, clip: Motion, canonical: Motion, skeleton: Skeleton, rigmap: RigMap
) -> Motion:
    """Build one frame on the body's rig, at its requested position, height and heading."""
    frame = key.pose_frame or 0
    if key.pose_seconds is not None:
        frame = round(key.pose_seconds * float(clip.fps))
    if frame >= clip.num_frames:
        name = "pose_frame" if key.pose_seconds is None else "pose_seconds"
        raise RequestError(f"key[{number}].{name}: the frame {frame} is not one of the pose's 0:{clip.num_frames}")
    own, pose = clip.slice(frame, frame + 1), canonical.slice(frame, frame + 1)
    same = clip.skeleton.matches(skeleton)
    if same and key.place is None and key.height is None and key.facing_deg is None:
        return own
    root, quats = pose.root_position.clone(), pose.local_quat_xyzw.clone()
    if key.place is not None:
        root[0, 0], root[0, 2] = key.place
    if key.height is not None:
        root[0, 1] = key.height
    if key.facing_deg is not None:
        turn = torch.deg2rad(torch.tensor([key.facing_deg], dtype=torch.float64)) - heading(quats[:, 0])
        quats[:, 0] = rotations.multiply(rotations.about_y(turn), quats[:, 0])
    placed = replace(pose, root_position=root, local_quat_xyzw=quats, source=None)
    return from_canonical(placed, rigmap, own if same else None)


def _interpolate_poses(poses: dict[int, Motion], frames: int) -> Motion:
    """Interpolate from pose to pose between their frames."""
    at = torch.tensor(sorted(poses))
    joined = reduce(Motion.join, (poses[frame] for frame in sorted(poses)))
    source = (torch.searchsorted(at, torch.arange(frames), right=True) - 1).clamp_min(0)
    motion = replace(joined, local_quat_xyzw=rotations.make_sign_continuous(joined.local_quat_xyzw)).pick(source)
    free = torch.ones(frames, dtype=torch.bool)
    free[at] = False
    return interpolate_missing(motion, MissingMask.of_frames(free, motion.num_joints))


@contextmanager
def _prefix_errors(where: str) -> Iterator[None]:
    """Prefix errors raised within by the key of the request."""
    try:
        yield
    except MapctlError as error:
        raise RequestError(f"{where}: {error}") from error


@dataclass(frozen=True)
class KeyInterval:
    """Interval between two neighbouring keyframes that are whole poses."""

    start: int
    """Frame of the first keyframe."""
    stop: int
    """Frame of the second keyframe."""
    suggested: int
    """Median number of frames between such poses in mocap."""
    usual: tuple[int, int]
    """Numbers of frames between which four of five of mocap's pairs lie."""
    metres: float
    """Distance of the hips over the ground, on this body, metres."""
    given_speed: float
    """Mean speed over this distance with the given timing, m/s."""
    suggested_speed: float
    """Mean speed over this distance with the suggested timing, m/s."""
    pose_distance_cm: float
    """Mean distance of the joints relative to the hips, cm."""

    @property
    def given(self) -> int:
        """Given number of frames between the keyframes."""
        return self.stop - self.start

    @property
    def reason(self) -> str:
        """Reason for the suggestion, with numbers."""
        low, high = self.usual
        verdict = "short" if self.given < low else "long" if self.given > high else "usual"
        if self.metres < TRAVELLING_DISTANCE:
            return (
                f"{verdict}: about in place ({self.metres:.2f} m), joints {self.pose_distance_cm:.0f} cm apart; mocap "
                f"mostly takes {low} to {high} frames"
            )
        return (
            f"{verdict}: {self.metres:.2f} m at {self.given_speed:.2f} m/s, where poses like these go at "
            f"{self.suggested_speed:.2f} m/s; mocap mostly takes {low} to {high} frames"
        )

    def summary(self) -> dict[str, Any]:
        """Return the interval as a report's JSON has it."""
        return asdict(self) | {"given": self.given, "reason": self.reason}


def suggest_intervals(
    motion: Motion,
    keys: Keys,
    timing: Callable[[Float[Tensor, "pairs features"], Float[Tensor, " pairs"]], Float[Tensor, "pairs 3"]],
    rig: Rig | None = None,
) -> list[KeyInterval]:
    """Suggest the time between neighbouring keyframes that are whole poses; others may lie between. `timing` estimates
    the 10th, 50th and 90th percentile of seconds by features of pairs and metres (see `priors.load_keyframe_timing`).
    RequestError for keys that do not fit the motion, and for fewer than two such poses."""
    key_frames = [key.frame for key in keys.checked(motion) if key.what == "pose"]
    if len(key_frames) < 2:
        raise RequestError(f"timing is suggested between whole poses; the keys have {len(key_frames)}, it takes two")
    canonical = to_canonical(motion.pick(torch.tensor(key_frames)), rig)[0]
    scale, fps = leg_length(canonical.skeleton) / leg_length(CANONICAL), float(motion.fps)
    body = Motion(CANONICAL, canonical.fps, canonical.root_position / scale, canonical.local_quat_xyzw)
    first = torch.arange(len(key_frames) - 1)
    distances = compute_travel_distance(body, first, first + 1)
    quantiles = (fps * timing(compute_pair_features(body, first, first + 1), distances)).tolist()
    metres = (scale * distances).tolist()
    pose_distances = (100 * scale * compute_pose_distance(body, first, first + 1)).tolist()
    intervals = []
    each = zip(pairwise(key_frames), quantiles, metres, pose_distances, strict=True)
    for (start, stop), counts, distance, pose_distance in each:
        low, suggested, high = (max(1, round(count)) for count in counts)
        speeds = distance * fps / (stop - start), distance * fps / suggested
        intervals.append(KeyInterval(start, stop, suggested, (low, high), distance, *speeds, pose_distance))
    return intervals
