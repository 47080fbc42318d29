"""A body fitted to positions of markers or joints: constant bones and marker offsets, a pose in every frame.

Each marker is at a constant offset in the frame of a joint (`marker_sets.toml`). Poses and, over the clip, bones and
offsets are found in turn by least squares, as OpenSim's scaling and inverse kinematics (Delp et al. 2007) and MoSh
(Loper et al. 2014) do. Hip centres start from the pelvis's width and depth (Harrington et al. 2007).
"""

import math
import re
import tomllib
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cache
from importlib.resources import files
from os import PathLike

import numpy as np
import torch
from jaxtyping import Bool, Float
from pydantic import RootModel
from torch import Tensor

from mapctl import joint_ranges, kinematics, rotations
from mapctl.errors import FileFormatError
from mapctl.formats import toml
from mapctl.formats.missing import MissingValues, interpolate_nan
from mapctl.formats.positions import Capture
from mapctl.formats.text import shorten, warn_once
from mapctl.formats.units import FileUnit, guess_unit
from mapctl.motion import Motion
from mapctl.skeleton import CANONICAL, Skeleton, mirror_name

_PARENTS, _NAMES = CANONICAL.parents, CANONICAL.names
_SHANK = ("LowerLeg", "Foot")
_LOOSE = ("spine", "chest", "neck", "head", "Shoulder", "UpperArm", "UpperLeg", "Toes")  # bones of any direction
_NEEDED = [side + part for side in ("left", "right") for part in ("UpperLeg", "LowerLeg", "Foot")]
# Bones of an adult where a canonical bone is not: the canonical body has narrow shoulders, and its ankles are high.
_ADULT = {"UpperArm": (0.11, 0.0, 0.0), "UpperLeg": (0.0865, -0.0219, 0.0), "Toes": (0.0, -0.05, 0.125)}
_SIGMA = 0.01  # metres by which a marker is off its segment
_OFFSET_SIGMA, _FREE_SIGMA, _CENTRE_SIGMA = 0.02, 0.2, 0.01  # metres by which an offset differs from the table's
_BONE_SIGMA = 0.1  # of a bone's length
_ACROSS_SIGMA, _TRUNK_SIGMA = 0.003, 0.025  # metres by which bones of limbs and of the trunk have another direction
_EVIDENCE = 1.0  # independent observations that a clip is worth: errors of skin and labels last
_REST_SIGMA = {"spine": 0.3, "chest": 0.3, "neck": 0.3, "head": 0.5, "Shoulder": 0.3, "Hand": 0.5, "Toes": 0.3}
_LIMB_SIGMA, _RANGE_SIGMA = 1.5, 0.1  # radians from the mid pose, and beyond a joint's range
_ELBOW = math.radians(5.0)  # by which a forearm turns across its hinge
_OUTLIER, _FAR_OUTLIER = 0.08, 1.0  # metres at which a marker counts a quarter, and while poses are far from it
_LOST_TRUST = 0.003  # weight of a marker that is lost, and interpolated
_TURNS, _STEPS = 4, 16  # of body and poses in turn; of Gauss and Newton
_LONGEST_STEP = 0.5  # radians
_TILT = math.radians(10.0)  # of the markers of a standing pelvis, forward
_SUBSET, _CHUNK = 120, 128  # frames over which a body is measured; frames that are solved at once
_FAR = 2.5  # of the height of the trunk over the feet, an axis along which a body travels farther does not point up
_SHORTEST = 0.01  # metres of a bone between joints at one point
_LARGE = 0.05  # metres of mean residual that are worth a warning
_SHANK_RANGE = (0.12, 0.8)  # metres from knee to ankle of bodies in a unit that may be right


_ABOVE = kinematics.find_joints_above(_PARENTS)
_MIRROR = torch.tensor([-1.0, 1.0, 1.0], dtype=torch.float64)


@dataclass(frozen=True, eq=False)
class Landmark:
    """Where a marker sticks."""

    on: int
    """Joint in whose frame it is constant."""
    of: int
    """Joint from which its offset leads to it: `on`, or a child of it."""
    at: tuple[float, float, float]
    """Offset on an adult, metres."""
    sigma: float = _OFFSET_SIGMA
    """Metres by which its offset differs between bodies."""


@dataclass(frozen=True, eq=False)
class MarkerFit(FileUnit):
    """How a body fits the markers of its file, in `Motion.source`."""

    residuals: Mapping[str, float]
    """Mean distance of each marker that is used from the body's, metres."""
    mean: float
    """The same over all markers and frames."""
    worst_frame: tuple[int, float]
    """Frame with the largest mean distance, and that distance."""
    unused: tuple[str, ...]
    """Markers of the file that stand for nothing known."""


def fit(
    path: str | PathLike[str], capture: Capture, markers: str | PathLike[str] | None = None
) -> tuple[Motion, MissingValues]:
    """Fit a canonical body, metres, Y up, to a capture; also return where nothing of a joint was seen.

    `markers` is a TOML that names the markers whose mean is a joint's centre. FileFormatError where hips, knees or
    ankles have no markers.
    """
    labels, landmarks, observed, unused = match_labels(path, capture, markers)
    _check_joints(path, landmarks)
    observed = _turn_up(observed, landmarks, capture.up)
    unit = _find_unit(path, observed, landmarks, capture.metres_per_unit)
    seen = torch.from_numpy(np.isfinite(observed).all(axis=2))
    flat = interpolate_nan(observed.reshape(len(observed), -1), np.zeros(3 * len(labels)))
    positions = torch.from_numpy(flat.reshape(observed.shape)) * unit.metres_per_unit
    frames = _pick_frames(seen)
    some, shown = positions[frames], seen[frames]
    body = first = _estimate_body(landmarks, some)
    trust, free = torch.where(seen, 1.0, _LOST_TRUST), torch.tensor([mark.sigma == _FREE_SIGMA for mark in landmarks])
    known = trust[frames] * torch.where(free, _LOST_TRUST, 1.0)  # where free markers are is not known at first
    pose = _find_poses(body, some, known, torch.eye(3).double().expand(len(some), len(_NAMES), 3, 3))
    for _ in range(_TURNS):
        body = _measure_body(body, first, some, shown, *pose)
        pose = _solve_poses(body, some, trust[frames], *pose, outlier=_OUTLIER, steps=_STEPS // 2)
    body = _measure_body(body, first, some, shown, *pose)
    between = (frames[1:] + frames[:-1]).double() / 2
    near = pose[1][torch.searchsorted(between, torch.arange(len(positions)).double())]
    chunks = zip(positions.split(_CHUNK), trust.split(_CHUNK), near.split(_CHUNK), strict=True)
    solved = [_find_poses(body, *chunk) for chunk in chunks]
    root, local = (torch.cat(values) for values in zip(*solved, strict=True))
    foot = _NAMES.index("leftFoot")
    size = float(body.bones[foot].norm() / CANONICAL.offsets[foot].norm())
    ends = {name: (x * size, y * size, z * size) for name, (x, y, z) in CANONICAL.end_offsets.items()}
    skeleton = Skeleton(_NAMES, _PARENTS, body.bones, ends)
    residual = (body.place(root, local)[0] - positions).norm(dim=-1).masked_fill(~seen, torch.nan)
    source = _report(path, residual, labels, unused, unit)
    quats = rotations.make_sign_continuous(rotations.from_matrix(local))
    return Motion(skeleton, capture.fps, root, quats, source=source), _find_missing(seen, landmarks)


def match_labels(
    path: str | PathLike[str], capture: Capture, markers: str | PathLike[str] | None
) -> tuple[list[str], list[Landmark], Float[np.ndarray, "frames markers 3"], tuple[str, ...]]:
    """Match a capture's labels with the table; return those that are known, where they stick, their positions, and
    the labels that are not. Of several subjects the one with most known markers is taken."""
    subjects, plain = [label.rpartition(":")[0] for label in capture.labels], [_simplify(one) for one in capture.labels]
    table, joints = _read_table()
    found = {} if markers is None else _read_markers(markers)
    known = {*table, *joints, *(_simplify(name) for names in found.values() for name in names)}
    counts = Counter(subject for subject, name in zip(subjects, plain, strict=True) if name in known)
    subject = counts.most_common(1)[0][0] if counts else ""
    if len([s for s in counts if counts[s] > counts[subject] / 2]) > 1:
        warn_once(f"{path}: has several subjects; {subject} is read, of {', '.join(sorted(counts))}")
    mine = [s == subject for s in subjects]
    on_pelvis = any(own and name in table and table[name].on == 0 for own, name in zip(mine, plain, strict=True))
    labels, landmarks, columns, used = [], [], [], set()
    for joint, names in found.items():
        own = [n for n, name in enumerate(plain) if name in map(_simplify, names) and mine[n]]
        if not own:
            raise FileFormatError(markers or path, f"{joint}: none of {', '.join(names)} is a marker of {path}")
        used |= set(own)
        labels.append(joint)
        landmarks.append(_as_centre(joint))
        columns.append(capture.positions[:, own].mean(axis=1))
    named = {landmark.of for landmark in landmarks}
    for n, name in enumerate(plain):
        landmark = table.get(name) if on_pelvis or name not in joints else joints[name]
        landmark = landmark or joints.get(name)
        if n in used or not mine[n] or landmark is None or np.isnan(capture.positions[:, n]).all():
            continue
        if landmark.of in named and landmark.sigma == _CENTRE_SIGMA:
            continue
        used.add(n)
        several = plain.count(name) > 1
        labels.append(capture.labels[n])
        landmarks.append(replace(landmark, sigma=_FREE_SIGMA) if several else landmark)
        columns.append(capture.positions[:, n])
    positions = np.stack(columns, axis=1) if columns else np.zeros((len(capture.positions), 0, 3))
    return labels, landmarks, positions, tuple(label for n, label in enumerate(capture.labels) if n not in used)


def _simplify(label: str) -> str:
    """Return a label without its subject and punctuation, in lower case."""
    return re.sub(r"[\W_]", "", label.rpartition(":")[2]).lower()


@cache
def _read_table() -> tuple[dict[str, Landmark], dict[str, Landmark]]:
    """Read the table: markers and centres of joints, each by its names on both sides."""
    rows = tomllib.loads(files("mapctl.formats").joinpath("marker_sets.toml").read_text("utf-8"))
    table, joints = {}, {}
    for side in ("left", "middle"):
        for row in rows[side].values():
            sigma = _FREE_SIGMA if row.get("free") else _OFFSET_SIGMA
            on = row["on"]
            for name in row["names"]:
                x, y, z = row["at"]
                of = row.get("of", on)
                table.update(_spell(name, "left", Landmark(_NAMES.index(on), _NAMES.index(of), (x, y, z), sigma)))
                if side == "left":
                    on_right, of_right = (_NAMES.index(mirror_name(joint)) for joint in (on, of))
                    table.update(_spell(name, "right", Landmark(on_right, of_right, (-x, y, z), sigma)))
    for joint, names in rows["joints"].items():
        for name in names:
            joints.update(_spell(name, "left", _as_centre(joint)))
            if mirror_name(joint) != joint:
                joints.update(_spell(name, "right", _as_centre(mirror_name(joint))))
    return table, joints


def _spell(name: str, side: str, landmark: Landmark) -> dict[str, Landmark]:
    """Spell a name of the table for a side."""
    words = (side[0], side) if "*" in name else (side,)
    return {name.replace("*", word).replace("@", word): landmark for word in words}


def _as_centre(joint: str) -> Landmark:
    own = _NAMES.index(joint)
    return Landmark(max(_PARENTS[own], 0), own, (0.0, 0.0, 0.0), _CENTRE_SIGMA)


class _MarkerTable(RootModel[dict[str, list[str]]]):
    """Markers by canonical joint."""


def _read_markers(path: str | PathLike[str]) -> dict[str, list[str]]:
    """Read a user's table of the markers by canonical joint."""
    found = toml.read(path, _MarkerTable, what="table of markers").root
    if wrong := [joint for joint in found if joint not in _NAMES]:
        allowed = f"allowed are canonical joints: {', '.join(_NAMES)}"
        raise FileFormatError(path, f"{shorten(wrong[0])}: there is no such joint; {allowed}")
    return found


def _check_joints(path: str | PathLike[str], landmarks: list[Landmark]) -> None:
    """Raise FileFormatError where the joints of the legs have no markers; hips may have three on the pelvis."""
    pelvis = [np.sign(mark.at[0]) for mark in landmarks if mark.on == mark.of == 0 and mark.sigma < _FREE_SIGMA]
    pelvis = len(pelvis) > 2 and {-1, 1} <= set(pelvis)
    known = {_NAMES[mark.of] for mark in landmarks if mark.on != mark.of and mark.sigma < _FREE_SIGMA}
    lacking = [joint for joint in _NEEDED if joint not in known and not (pelvis and joint.endswith("UpperLeg"))]
    if lacking:
        raise FileFormatError(
            path,
            f"has no markers of known names for {', '.join(lacking)}; name them in a TOML, as {lacking[0]} = ['LABEL'],"
            " and give it by --markers of mapctl convert",
        )


def _turn_up(observed: np.ndarray, landmarks: list[Landmark], up: str | None) -> np.ndarray:
    """Rotate positions so that Y is up: the axis that the file states, else that from the feet to the hips and above
    among those along which the body does not travel far."""
    low = [n for n, landmark in enumerate(landmarks) if _NAMES[landmark.of].endswith(("Foot", "Toes"))]
    high = [n for n, landmark in enumerate(landmarks) if landmark.on == 0 or _NAMES[landmark.on] in ("chest", "head")]
    middle, feet = (interpolate_nan(_average_seen(observed[:, own]), np.zeros(3)) for own in (high, low))
    rise, travel = np.median(middle - feet, axis=0), np.ptp(middle, axis=0)
    grounded = travel > _FAR * np.linalg.norm(rise)
    axis = int((np.abs(rise) * ~grounded).argmax()) if up is None else "XYZ".index(up[1])
    sign = np.sign(rise[axis]) if up is None else (-1.0 if up[0] == "-" else 1.0)
    y = sign * np.eye(3)[axis]
    z = sign * (np.eye(3)[2] if axis < 2 else -np.eye(3)[1])  # X stays where it can
    return observed @ np.stack([np.cross(y, z), y, z], axis=1)


def _find_unit(
    path: str | PathLike[str], observed: np.ndarray, landmarks: list[Landmark], stated: float | None
) -> FileUnit:
    """Find the unit: the one that is stated, or by the size of the body where none is or it cannot be."""
    shank, foot = _measure_shanks(observed, landmarks), _NAMES.index("leftFoot")
    if not shank:
        raise FileFormatError(path, "shows a knee and its ankle in no frame, or both at one point")
    if stated is not None and _SHANK_RANGE[0] < shank * stated < _SHANK_RANGE[1]:
        return FileUnit(stated)
    offsets = CANONICAL.offsets * (shank / float(CANONICAL.offsets[foot].norm()))
    guess = guess_unit(_NAMES, _PARENTS, offsets.numpy(), end_offsets={})
    if stated is None:
        return guess
    doubt = f"the file states a unit of {stated:g} m, in which shanks are {shank * stated:.3g} m"
    return FileUnit(guess.metres_per_unit, unit_doubt=doubt)


def _average_seen(observed: Float[np.ndarray, "frames markers 3"]) -> Float[np.ndarray, "frames 3"]:
    """Return the means of the markers that are seen; NaN where none is."""
    count = np.isfinite(observed).sum(axis=1)
    return np.where(count > 0, np.nan_to_num(observed).sum(axis=1) / np.maximum(count, 1), np.nan)


def _measure_shanks(observed: Float[np.ndarray, "frames markers 3"], landmarks: list[Landmark]) -> float:
    """Return the length from knee to ankle, median of both sides, in the unit of the positions; 0 if it is not seen."""
    found = []
    for side in ("left", "right"):
        ends = ([n for n, m in enumerate(landmarks) if _NAMES[m.of] == side + part and m.on != m.of] for part in _SHANK)
        knee, ankle = (_average_seen(observed[:, own]) for own in ends)
        found.append(np.linalg.norm(knee - ankle, axis=1))
    lengths = np.concatenate(found)
    return float(np.median(lengths[np.isfinite(lengths)])) if np.isfinite(lengths).any() else 0.0


def _pick_frames(seen: Bool[Tensor, "frames markers"]) -> Tensor:
    """Pick frames over the clip in which most markers are seen."""
    count = seen.sum(dim=1)
    good = (count >= torch.quantile(count.double(), 0.5)).nonzero()[:, 0]
    return good[torch.linspace(0, len(good) - 1, min(_SUBSET, len(good))).round().long()]


@dataclass(frozen=True, eq=False)
class _Body:
    """Bones and marker offsets of one performer."""

    landmarks: list[Landmark]
    bones: Float[Tensor, "joints 3"]
    """Each joint in its parent's frame in the T-pose, metres."""
    offsets: Float[Tensor, "markers 3"]
    """Each marker from its joint `of`, in the frame of `on`, metres."""

    @property
    def on(self) -> list[int]:
        return [landmark.on for landmark in self.landmarks]

    @property
    def of(self) -> list[int]:
        return [landmark.of for landmark in self.landmarks]

    def place(
        self, root: Float[Tensor, "frames 3"], local: Float[Tensor, "frames joints 3 3"]
    ) -> tuple[Float[Tensor, "frames markers 3"], Float[Tensor, "frames joints 3"], Float[Tensor, "frames joints 3 3"]]:
        """Return the markers of poses, the joints, and their world rotations."""
        joints, world = kinematics.chain_matrices(self.bones, _PARENTS, local)
        joints = joints + root[:, None]
        return joints[:, self.of] + (world[:, self.on] @ self.offsets[..., None])[..., 0], joints, world


def _estimate_body(landmarks: list[Landmark], positions: Float[Tensor, "frames markers 3"]) -> _Body:
    """Estimate a body of the table's proportions and the shanks' size, with hip centres by the pelvis's width and depth
    (Harrington et al. 2007, equations without the length of the legs)."""
    size = _measure_shanks(positions.numpy(), landmarks) / float(CANONICAL.offsets[_NAMES.index("leftFoot")].norm())
    bones = CANONICAL.offsets.clone()
    for joint, name in enumerate(_NAMES):
        for part, bone in _ADULT.items():
            if name.endswith(part):
                bones[joint] = torch.tensor(bone).double() * (_MIRROR if name.startswith("right") else 1.0)
    bones, offsets = bones * size, torch.tensor([mark.at for mark in landmarks]).double() * size
    centres = {mark.of: positions[:, n] for n, mark in enumerate(landmarks) if mark.sigma == _CENTRE_SIGMA}
    for joint in sorted(centres):
        if (parent := _PARENTS[joint]) in centres:
            length = float((centres[joint] - centres[parent]).norm(dim=-1).median())
            bones[joint] *= max(length, _SHORTEST) / float(bones[joint].norm())
    pelvis = [n for n, mark in enumerate(landmarks) if mark.on == mark.of == 0 and mark.sigma == _OFFSET_SIGMA]
    front, back = ([n for n in pelvis if sign * landmarks[n].at[2] > 0] for sign in (1, -1))
    if len(front) == 2 and back:
        middle = positions[:, front].mean(dim=1)
        width = float((positions[:, front[0]] - positions[:, front[1]]).norm(dim=-1).median())
        depth = float((middle - positions[:, back].mean(dim=1)).norm(dim=-1).median())
        hips = torch.tensor([0.0, -0.30 * width - 0.0109, -0.24 * depth - 0.0099]).double()  # from between the ASIS
        tilt = rotations.rotation_vector_to_matrix(torch.tensor([_TILT, 0.0, 0.0]).double())
        for n in pelvis:
            at = offsets[n] * torch.tensor([1.0, 0.0, 0.0])
            at[0], at[2] = (at[0].sign() * width / 2, 0.0) if n in front else (at[0], -depth)
            offsets[n] = tilt @ (at - hips)
            offsets[n, 1] += bones[_NAMES.index("leftUpperLeg"), 1]
        for side, sign in (("left", 1.0), ("right", -1.0)):
            bones[_NAMES.index(side + "UpperLeg"), 0] = sign * (0.33 * width + 0.0073)
    return _Body(landmarks, bones, offsets)


def _find_poses(
    body: _Body,
    positions: Float[Tensor, "frames markers 3"],
    trust: Float[Tensor, "frames markers"],
    local: Float[Tensor, "frames joints 3 3"],
) -> tuple[Float[Tensor, "frames 3"], Float[Tensor, "frames joints 3 3"]]:
    """Find poses from others, moved and turned to where their markers are nearest (Kabsch 1976); what is an
    outlier shows once poses are near."""
    local = torch.cat([torch.eye(3).double().expand(len(local), 1, 3, 3), local[:, 1:]], dim=1)
    own = [n for n, mark in enumerate(body.landmarks) if mark.sigma < _FREE_SIGMA]
    within, wanted = body.place(0 * positions[:, 0], local)[0][:, own], positions[:, own]
    centre, middle = within.mean(dim=1), wanted.mean(dim=1)
    first, _, last = torch.linalg.svd((wanted - middle[:, None]).mT @ (within - centre[:, None]))
    first[:, :, 2] *= torch.det(first @ last)[:, None]  # no reflection
    local[:, 0] = first @ last
    pose = middle - (local[:, 0] @ centre[..., None])[..., 0], local
    for outlier in (_FAR_OUTLIER, _OUTLIER):
        pose = _solve_poses(body, positions, trust, *pose, outlier=outlier, steps=_STEPS)
    return pose


def _solve_poses(
    body: _Body,
    positions: Float[Tensor, "frames markers 3"],
    trust: Float[Tensor, "frames markers"],
    root: Float[Tensor, "frames 3"],
    local: Float[Tensor, "frames joints 3 3"],
    *,
    outlier: float,
    steps: int,
) -> tuple[Float[Tensor, "frames 3"], Float[Tensor, "frames joints 3 3"]]:
    """Solve for the poses whose markers are nearest, by Levenberg's and Marquardt's method on turns about the world's
    axes: joints are weakly held in their mid poses, strongly within their ranges; outliers count less (Geman and
    McClure 1987)."""
    frames, ranges, parents, one = len(positions), _find_ranges(), list(_PARENTS[1:]), torch.eye(3).double()
    moves, turned = _ABOVE[body.on].double(), torch.arange(3, 3 + 3 * len(_NAMES))
    rest = torch.tensor([_find_rest_sigma(name) for name in _NAMES[1:]]).double() ** -2
    best, damping = (), torch.full((frames,), 1e-2).double()
    for step in range(steps + 1):
        points, joints, world = body.place(root, local)
        missed, angles = positions - points, ranges.to_angles(local[:, 1:])
        within = ranges.to_matrices(torch.minimum(torch.maximum(angles, ranges.low), ranges.high))
        targets = torch.stack([ranges.mid_matrix.expand_as(within), within])
        away = rotations.to_rotation_vector(rotations.from_matrix(local[:, 1:] @ targets.mT))
        beyond = ranges.find_excess(angles).amax(dim=-1) > 0
        held = torch.stack([rest.expand(frames, -1), beyond * _RANGE_SIGMA**-2])
        square = missed.square().sum(dim=-1)
        cost = (trust * square / (1 + square / outlier**2)).sum(dim=1) / _SIGMA**2
        cost = cost + (held * away.square().sum(dim=-1)).sum(dim=(0, 2))
        levers = (points[:, :, None] - joints[:, None]) * moves[..., None]
        turns = torch.linalg.cross(one.expand(*levers.shape, 3), levers[..., None, :]).movedim(-1, 2).flatten(3)
        jacobian = torch.cat([one.expand(*missed.shape, 3), turns], dim=3).flatten(1, 2)
        weighted = jacobian * (trust * _weigh(missed, outlier)).repeat_interleave(3, dim=1)[..., None]
        normal, gradient = weighted.mT @ jacobian, (weighted.mT @ missed.flatten(1)[..., None])[..., 0]
        # a turn about axes of the world ahead of the joint's rotation is itself the change of its distance to a target
        above = world[:, parents]
        normal[:, turned[3:], turned[3:]] += held.sum(dim=0).repeat_interleave(3, dim=1)
        gradient[:, 6:] -= (above @ (held[..., None] * away).sum(dim=0)[..., None]).flatten(1)
        better = cost <= (best[0] if best else cost)
        new = (cost, root, local, above, normal, gradient)
        damping = torch.where(better, damping / 4, damping * 8).clamp(1e-6, 1e3)
        pairs = zip(new, best or new, strict=True)
        best = tuple(torch.where(better.view(-1, *[1] * (now.ndim - 1)), now, old) for now, old in pairs)
        _, root, local, above, normal, gradient = best
        if step < steps:
            diagonal = normal.diagonal(dim1=-2, dim2=-1)
            change = torch.linalg.solve(normal + torch.diag_embed(damping[:, None] * diagonal + 1e-3), gradient)
            root, turn = root + change[:, :3], change[:, 3:].reshape(frames, -1, 3)
            turn = turn / (turn.norm(dim=-1, keepdim=True) / _LONGEST_STEP).clamp_min(1.0)
            turn = torch.cat([turn[:, :1], (above.mT @ turn[:, 1:, :, None])[..., 0]], dim=1)
            local = rotations.rotation_vector_to_matrix(turn) @ local
    return root, local


@cache
def _find_ranges() -> joint_ranges.JointRanges:
    """Return the joints' ranges with elbows that are hinges: so the forearm shows how the upper arm turns."""
    ranges = joint_ranges.load()
    elbows = torch.tensor([name.endswith("LowerArm") for name in _NAMES[1:]])[:, None] & (ranges.axes == 2)
    low, high = (torch.where(elbows, sign * _ELBOW, ends) for sign, ends in ((-1, ranges.low), (1, ranges.high)))
    return replace(ranges, low=low, high=high)


def _weigh(missed: Float[Tensor, "frames markers 3"], outlier: float) -> Float[Tensor, "frames markers"]:
    """Weigh markers by how far off they are, 1/m^2."""
    return (1 + missed.square().sum(dim=-1) / outlier**2) ** -2 / _SIGMA**2


def _find_rest_sigma(name: str) -> float:
    return next((sigma for part, sigma in _REST_SIGMA.items() if name.endswith(part)), _LIMB_SIGMA)


def _measure_body(
    body: _Body,
    first: _Body,
    positions: Float[Tensor, "frames markers 3"],
    seen: Bool[Tensor, "frames markers"],
    root: Float[Tensor, "frames 3"],
    local: Float[Tensor, "frames joints 3 3"],
) -> _Body:
    """Measure bones, the same on both sides, and marker offsets over poses: linear least squares in which the position
    of the root is free, near the first estimate."""
    points, _, world = body.place(root, local)
    weight = _weigh(positions - points, _OUTLIER) * seen
    markers, tied = (
        len(body.landmarks),
        {name: n for n, name in enumerate(n for n in _NAMES[1:] if not n.startswith("right"))},
    )
    columns = len(tied)
    design = torch.zeros(len(positions), markers, 3, columns + markers, 3).double()
    for joint, name in enumerate(_NAMES[1:], start=1):
        turns = world[:, _PARENTS[joint]] * (_MIRROR if name.startswith("right") else 1.0)
        carried = _ABOVE[body.of][:, joint]
        design[:, carried, :, tied.get(name, tied.get(mirror_name(name)))] += turns[:, None]
    for n, on in enumerate(body.on):
        design[:, n, :, columns + n] += world[:, on]
    design, share = design.flatten(3), (weight / weight.sum(dim=1, keepdim=True).clamp_min(1e-9))[..., None]
    design = design - (share[..., None] * design).sum(dim=1, keepdim=True)
    wanted = positions - (share * positions).sum(dim=1, keepdim=True)
    weighted = (design * weight[..., None, None]).flatten(0, 2) * (_EVIDENCE / len(positions))
    normal, right = weighted.T @ design.flatten(0, 2), weighted.T @ wanted.flatten()
    start, held = [], []
    for name in tied:
        bone = first.bones[_NAMES.index(name)]
        along, spread = bone / bone.norm(), _TRUNK_SIGMA if name.endswith(_LOOSE) else _ACROSS_SIGMA
        line = along[:, None] * along
        held.append(line / (_BONE_SIGMA * bone.norm()) ** 2 + (torch.eye(3).double() - line) / spread**2)
        start.append(bone)
    for mark, offset in zip(body.landmarks, first.offsets, strict=True):
        held.append(torch.eye(3).double() / mark.sigma**2)
        start.append(offset)
    prior, start = torch.block_diag(*held), torch.cat(start)
    found = torch.linalg.solve(normal + prior, right + prior @ start).reshape(-1, 3)
    bones = body.bones.clone()
    for joint, name in enumerate(_NAMES[1:], start=1):
        own = found[tied.get(name, tied.get(mirror_name(name)))]
        bones[joint] = (
            own * _MIRROR
            if name.startswith("right")
            else own * torch.tensor([float(name.startswith("left")), 1.0, 1.0])
        )
    return _Body(body.landmarks, bones, found[columns:])


def _report(
    path: str | PathLike[str],
    residual: Float[Tensor, "frames markers"],
    labels: list[str],
    unused: tuple[str, ...],
    unit: FileUnit,
) -> MarkerFit:
    """Report how near the markers are; a bad fit is a warning."""
    mean, by_frame = float(residual.nanmean()), residual.nanmean(dim=1).nan_to_num(0.0)
    frame = int(by_frame.argmax())
    by_marker = dict(zip(labels, residual.nanmean(dim=0).tolist(), strict=True))
    if mean > _LARGE:
        worst = max(by_marker, key=lambda label: by_marker[label])
        warn_once(
            f"{path}: the body is {100 * mean:.1f} cm from the markers on average, most from {worst}; see mapctl info"
        )
    worst_frame = (frame, float(by_frame[frame]))
    return MarkerFit(unit.metres_per_unit, by_marker, mean, worst_frame, unused, unit_doubt=unit.unit_doubt)


def _find_missing(seen: Bool[Tensor, "frames markers"], landmarks: list[Landmark]) -> MissingValues:
    """Find where nothing is seen of a joint or of those below it, of joints that have markers."""
    below = _ABOVE[[landmark.on for landmark in landmarks]]
    rotation = ~((seen[:, :, None] & below).any(dim=1)) & below.any(dim=0)
    position = torch.zeros_like(rotation)
    position[:, 0] = ~seen.any(dim=1)
    return MissingValues(rotation, position)
