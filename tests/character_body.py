"""A person of joints and triangles, for files of characters that tests make: in metres, Y up, facing +Z."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

Array = np.ndarray

_TRUNK = {
    "hips": ("", (0.0, 0.98, 0.0)),
    "spine": ("hips", (0.0, 1.08, -0.01)),
    "spine1": ("spine", (0.0, 1.20, -0.015)),
    "chest": ("spine1", (0.0, 1.33, -0.015)),
    "neck": ("chest", (0.0, 1.50, -0.02)),
    "head": ("neck", (0.0, 1.59, 0.0)),
    "headEnd": ("head", (0.0, 1.76, 0.02)),
}
_LIMBS = {
    "Shoulder": ("chest", (0.05, 1.45, -0.01)),
    "UpperArm": ("Shoulder", (0.18, 1.45, -0.02)),
    "LowerArm": ("UpperArm", (0.46, 1.45, -0.025)),
    "Hand": ("LowerArm", (0.71, 1.45, -0.01)),
    "Finger": ("Hand", (0.79, 1.45, 0.0)),
    "FingerEnd": ("Finger", (0.87, 1.44, 0.0)),
    "UpperLeg": ("hips", (0.095, 0.92, 0.0)),
    "LowerLeg": ("UpperLeg", (0.10, 0.50, 0.01)),
    "Foot": ("LowerLeg", (0.10, 0.09, -0.02)),
    "Toes": ("Foot", (0.105, 0.03, 0.11)),
    "ToesEnd": ("Toes", (0.105, 0.03, 0.18)),
}
SIDES = (("left", 1.0), ("right", -1.0))


def _tables() -> tuple[dict[str, str], dict[str, Array]]:
    parents = {name: parent for name, (parent, _) in _TRUNK.items()}
    positions = {name: np.array(position) for name, (_, position) in _TRUNK.items()}
    for side, sign in SIDES:
        for part, (parent, (x, y, z)) in _LIMBS.items():
            parents[side + part] = parent if parent in _TRUNK else side + parent
            positions[side + part] = np.array([sign * x, y, z])
    return parents, positions


PARENTS, PLACES = _tables()
"""Parent of each joint, and its position in the T-pose, metres; parents come first."""
ENDS = tuple(name for name in PARENTS if name.endswith("End"))
"""Joints that only show where the last bones end."""
POSES: Mapping[str, Mapping[str, tuple[str, float]]] = {
    "T": {},
    "A": {"leftUpperArm": ("z", -45.0), "rightUpperArm": ("z", 45.0)},
    "bent": {
        "leftUpperArm": ("z", -70.0),
        "rightUpperArm": ("z", 65.0),
        "leftLowerArm": ("y", -40.0),
        "spine": ("x", 12.0),
        "leftUpperLeg": ("x", -35.0),
        "leftLowerLeg": ("x", 50.0),
        "head": ("y", 25.0),
    },
}
"""Turns of joints against the T-pose, about the body's axes, degrees."""


def bone_frames(*, along_y: bool, roll_deg: float) -> dict[str, Rotation]:
    """World rotation of each joint's frame in the T-pose: aligned with the world, or with Y along the bone as Blender
    has them, each rolled a little more than the one before."""
    if not along_y:
        return dict.fromkeys(PARENTS, Rotation.identity())
    child = {parent: name for name, parent in reversed(PARENTS.items())}
    frames: dict[str, Rotation] = {}
    for number, (name, parent) in enumerate(PARENTS.items()):
        ends = (PLACES[parent], PLACES[name]) if name in ENDS else (PLACES[name], PLACES[child[name]])
        y = (ends[1] - ends[0]) / np.linalg.norm(ends[1] - ends[0])
        ahead = np.array([0.0, 0.0, 1.0]) if abs(y[2]) < 0.8 else np.array([0.0, 1.0, 0.0])
        z = ahead - (ahead @ y) * y
        z /= np.linalg.norm(z)
        rolled = Rotation.from_euler("y", roll_deg * (number % 7), degrees=True)
        frames[name] = Rotation.from_matrix(np.stack([np.cross(y, z), y, z], axis=1)) * rolled
    return frames


def pose_turns(pose: str) -> dict[str, Rotation]:
    """How each joint has turned in the world against the T-pose."""
    turns: dict[str, Rotation] = {}
    for name, parent in PARENTS.items():
        axis, degrees = POSES[pose].get(name, ("x", 0.0))
        above = turns[parent] if parent else Rotation.identity()
        turns[name] = above * Rotation.from_euler(axis, degrees, degrees=True)
    return turns


def pose_places(turns: Mapping[str, Rotation]) -> dict[str, Array]:
    """Where the joints are, the hips as in the T-pose."""
    positions: dict[str, Array] = {}
    for name, parent in PARENTS.items():
        offset = PLACES[name] - (PLACES[parent] if parent else 0.0)
        positions[name] = offset if not parent else positions[parent] + turns[parent].apply(offset)
    return positions


@dataclass(frozen=True, eq=False)
class Part:
    """Triangles that look alike, in the T-pose."""

    name: str
    vertices: Array
    """(n, 3) metres."""
    normals: Array
    """(n, 3) unit."""
    faces: Array
    """(m, 3), counter-clockwise seen from outside."""
    uv: Array
    """(n, 2): around, and along from 0 to 1."""
    weights: Mapping[str, Array]
    """(n,) share by joint; each vertex's add up to 1, of 4 joints at most."""


# Centres and half widths (across, ahead), metres, from one end to the other; and from where on each joint carries.
_TORSO = [
    ((0.0, 0.86, 0.0), (0.12, 0.09)),
    ((0.0, 0.98, 0.0), (0.165, 0.115)),
    ((0.0, 1.12, 0.0), (0.135, 0.105)),
    ((0.0, 1.33, 0.0), (0.17, 0.12)),
    ((0.0, 1.46, -0.01), (0.13, 0.09)),
    ((0.0, 1.53, -0.015), (0.06, 0.06)),
]
_HEAD = [((0.0, 1.50, -0.01), (0.052, 0.055)), ((0.0, 1.60, 0.0), (0.06, 0.07)), ((0.0, 1.76, 0.01), (0.08, 0.10))]
_ARM = [
    ((0.04, 1.45, -0.01), (0.07, 0.065)),
    ((0.18, 1.45, -0.02), (0.055, 0.055)),
    ((0.46, 1.45, -0.025), (0.04, 0.04)),
    ((0.71, 1.45, -0.01), (0.028, 0.03)),
]
_HAND = [((0.69, 1.45, -0.01), (0.022, 0.03)), ((0.79, 1.448, 0.0), (0.02, 0.045)), ((0.88, 1.44, 0.0), (0.012, 0.03))]
_LEG = [
    ((0.095, 1.0, 0.0), (0.085, 0.10)),
    ((0.098, 0.8, 0.0), (0.085, 0.09)),
    ((0.10, 0.5, 0.01), (0.055, 0.06)),
    ((0.10, 0.08, -0.02), (0.04, 0.042)),
]
_SHOE = [
    ((0.10, 0.045, -0.09), (0.045, 0.045)),
    ((0.105, 0.045, 0.0), (0.048, 0.045)),
    ((0.105, 0.035, 0.11), (0.05, 0.035)),
    ((0.105, 0.03, 0.20), (0.04, 0.03)),
]
_BLEND = 0.08  # metres before and after a joint over which the next one takes over


def build_parts(detail: int = 1) -> list[Part]:
    """The body in the T-pose, some 1000 vertices at detail 1 and nine times as many at detail 3; soles are at 0."""
    trunk = ["hips", "spine", "spine1", "chest", "neck"]
    shirt = [_tube(_TORSO, trunk, (1, 0, 0), 1.0, detail)]
    skin, trousers, shoes = [_tube(_HEAD, ["neck", "head"], (1, 0, 0), 1.0, detail)], [], []
    for side, sign in SIDES:
        arm = ["chest", *(side + part for part in ("Shoulder", "UpperArm", "LowerArm", "Hand"))]
        shirt.append(_tube(_ARM, arm, (0, 1, 0), sign, detail))
        skin.append(_tube(_HAND, [side + "Hand", side + "Finger"], (0, 1, 0), sign, detail))
        legs = ["hips", *(side + part for part in ("UpperLeg", "LowerLeg", "Foot"))]
        trousers.append(_tube(_LEG, legs, (1, 0, 0), sign, detail))
        shoes.append(_tube(_SHOE, [side + "Foot", side + "Toes"], (1, 0, 0), sign, detail))
    groups = {"shirt": shirt, "skin": skin, "trousers": trousers, "shoes": shoes}
    return [_merge(name, tubes) for name, tubes in groups.items()]


def _tube(spine: Sequence, joints: Sequence[str], across: Sequence[float], sign: float, detail: int) -> Part:
    """A closed tube around the points of a spine; `sign` -1 mirrors it to the right."""
    centres, widths = (np.array(column) for column in zip(*spine, strict=True))
    lengths = np.insert(np.cumsum(np.linalg.norm(np.diff(centres, axis=0), axis=1)), 0, 0.0)
    rings, around = 2 * detail * len(spine) + 6, 12 * detail + 1
    along = lengths[-1] * (1 - np.cos(np.pi * np.linspace(0.02, 0.98, rings))) / 2
    middle = np.stack([np.interp(along, lengths, centres[:, k]) for k in range(3)], axis=1)
    radii = np.stack([np.interp(along, lengths, widths[:, k]) for k in range(2)], axis=1)
    round_off = np.clip(np.minimum(along, lengths[-1] - along) / 0.03, 0, 1)
    radii = radii * np.sqrt(1 - (1 - round_off) ** 2)[:, None]
    axis = np.gradient(middle, axis=0)
    axis /= np.linalg.norm(axis, axis=1, keepdims=True)
    side = np.array(across) - axis * (axis @ np.array(across))[:, None]
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    angle = np.linspace(0, 2 * np.pi, around)
    out = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    frames = np.stack([side, np.cross(axis, side)], axis=1)
    vertices = middle[:, None] + np.einsum("ak,rk,rkc->rac", out, radii, frames)
    normals = np.einsum("ak,rk,rkc->rac", out, radii[:, ::-1] + 1e-6, frames)
    uv = np.stack(np.broadcast_arrays(angle / (2 * np.pi), (along / lengths[-1])[:, None]), axis=-1)
    weights = _share(along, [_arc(joint, sign, middle, along) for joint in joints], joints, around)
    flip = np.array([sign, 1.0, 1.0])
    faces = _grid_faces(rings, around)
    return Part(
        "",
        (vertices * flip).reshape(-1, 3),
        (normals / np.linalg.norm(normals, axis=-1, keepdims=True) * flip).reshape(-1, 3),
        faces if sign > 0 else faces[:, ::-1],
        uv.reshape(-1, 2),
        weights,
    )


def _arc(joint: str, sign: float, middle: Array, along: Array) -> float:
    """How far along a tube its joint is."""
    position = PLACES[joint] * np.array([sign, 1.0, 1.0])
    return float(along[np.argmin(np.linalg.norm(middle - position, axis=1))])


def _share(along: Array, starts: Sequence[float], joints: Sequence[str], around: int) -> dict[str, Array]:
    """Shares of joints that take over from each other smoothly."""
    taken = np.clip((along[:, None] - np.array(starts)) / (2 * _BLEND) + 0.5, 0, 1)
    taken = taken * taken * (3 - 2 * taken)
    taken[:, 0] = 1.0
    taken = np.minimum.accumulate(taken, axis=1)
    shares = taken - np.append(taken[:, 1:], np.zeros((len(along), 1)), axis=1)
    weakest = np.sort(shares, axis=1)[:, ::-1][:, min(3, shares.shape[1] - 1), None]
    shares = np.where(shares >= np.maximum(weakest, 1e-4), shares, 0.0)
    shares /= shares.sum(axis=1, keepdims=True)
    return {joint: np.repeat(shares[:, k], around) for k, joint in enumerate(joints)}


def _grid_faces(rings: int, around: int) -> Array:
    """Triangles of a tube, and of the discs that close it."""
    index = np.arange(rings * around).reshape(rings, around)
    a, b, c, d = index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]
    sides = np.concatenate([np.stack([a, b, c], -1).reshape(-1, 3), np.stack([a, c, d], -1).reshape(-1, 3)])
    fan = np.stack([np.zeros(around - 3, int), np.arange(1, around - 2), np.arange(2, around - 1)], axis=1)
    return np.concatenate([sides, index[0][fan[:, ::-1]], index[-1][fan]])


def _merge(name: str, parts: Sequence[Part]) -> Part:
    counts = np.cumsum([0, *(len(part.vertices) for part in parts)])
    joints = dict.fromkeys(joint for part in parts for joint in part.weights)
    none = [np.zeros(len(part.vertices)) for part in parts]
    return Part(
        name,
        np.concatenate([part.vertices for part in parts]),
        np.concatenate([part.normals for part in parts]),
        np.concatenate([part.faces + start for part, start in zip(parts, counts, strict=False)]),
        np.concatenate([part.uv for part in parts]),
        {j: np.concatenate([p.weights.get(j, zero) for p, zero in zip(parts, none, strict=True)]) for j in joints},
    )
