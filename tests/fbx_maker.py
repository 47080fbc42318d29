"""Text files of FBX 7.4 with an armature, a skin and takes, made here from nothing, and where they have their joints.

Joints turn by any of FBX's six orders, on top of pre-rotations, as exporters of Maya and MotionBuilder write them.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from os import PathLike

import numpy as np
from character_body import ENDS, PARENTS, PLACES, build_parts
from scipy.spatial.transform import Rotation

JOINTS = tuple(name for name in PARENTS if name not in ENDS)
"""The limbs, parents first."""
TICKS = 46_186_158_000
"""Ticks of FBX's clock in a second."""
_ORDERS = ("xyz", "xzy", "yzx", "yxz", "zxy", "zyx")
_RATES = {24: 11, 25: 10, 30: 6, 60: 3, 120: 1}
_Z_UP = Rotation.from_euler("x", 90, degrees=True)


@dataclass(frozen=True, eq=False)
class MadeFbx:
    """Truth of the file, in metres and Y up."""

    positions: np.ndarray
    """(frames, joints, 3) of the limbs in the first take."""
    bound: np.ndarray
    """(joints, 3) in the pose in which the skin is bound: a T-pose."""
    vertices: np.ndarray
    """(n, 3) of the skin in that pose."""


class _Document:
    """Objects and connections, numbered."""

    def __init__(self):
        self.objects, self.links, self.count = list[str](), list[str](), 1000

    def add(self, kind: str, name: str, sort: str, body: str, parent: int | None = 0, role: str = "") -> int:
        self.count += 1
        self.objects.append(f'\t{kind}: {self.count}, "{name}", "{sort}" {{\n{body}\n\t}}')
        if parent is not None:
            self.link(self.count, parent, role)
        return self.count

    def link(self, child: int, parent: int, role: str = "") -> None:
        self.links.append(f'\tC: "{"OP" if role else "OO"}",{child},{parent}' + (f', "{role}"' if role else ""))


def make_fbx(
    path: str | PathLike[str],
    *,
    version: int = 7400,
    unit_cm: float = 1.0,
    z_up: bool = False,
    rate: int = 30,
    frames: int = 6,
    takes: Sequence[str] = ("Take 001",),
    names: Sequence[str] = ("Armature",),
    skin: bool = True,
    scale: Sequence[float] = (1.0, 1.0, 1.0),
    parts: Sequence[str] = ("shirt", "skin", "trousers", "shoes"),
    posed: bool = False,
    seed: int = 0,
) -> MadeFbx:
    """Write a file of a person for each name, below a node of that name that is scaled by `scale`. With `posed` the
    nodes stand otherwise than in the pose in which the skin is bound."""
    random, document = np.random.default_rng(seed), _Document()
    turn = _Z_UP if z_up else Rotation.identity()
    result = [
        _add_person(document, random, n, turn, 0.01 * unit_cm, frames, rate, takes, skin, scale, parts, posed)
        for n in names
    ]
    head = [
        f"; FBX {version // 1000}.{version // 100 % 10}.0 project file",
        f"FBXHeaderExtension:  {{\n\tFBXHeaderVersion: 1003\n\tFBXVersion: {version}\n}}",
        "GlobalSettings:  {\n\tVersion: 1000\n\tProperties70:  {",
        *(f'\t\tP: "{key}", "int", "Integer", "",{value}' for key, value in _axes(z_up).items()),
        f'\t\tP: "UnitScaleFactor", "double", "Number", "",{unit_cm}',
        f'\t\tP: "TimeMode", "enum", "", "",{_RATES[rate]}\n\t}}\n}}',
    ]
    text = [*head, "Objects:  {", *document.objects, "}", "Connections:  {", *document.links, "}", ""]
    with open(path, "w", encoding="utf-8") as opened:  # noqa: PTH123 - any path-like
        opened.write("\n".join(text))
    return result[0]


def _axes(z_up: bool) -> dict[str, int]:
    up, front = (2, 1) if z_up else (1, 2)
    signs = {"UpAxisSign": 1, "FrontAxisSign": -1 if z_up else 1, "CoordAxisSign": 1}
    return {"UpAxis": up, "FrontAxis": front, "CoordAxis": 0, **signs}


def _add_person(document, random, name, turn, metres, frames, rate, takes, skin, scale, only, posed) -> MadeFbx:
    top = document.add("Model", f"Model::{name}", "Null", _properties(("Lcl Scaling", scale)))
    size = 1.0 / scale[0]
    pre = Rotation.from_rotvec(random.uniform(-1, 1, (len(JOINTS), 3)))
    own = dict(zip(JOINTS, pre, strict=True))
    bound: dict[str, Rotation] = {}
    limbs: dict[str, int] = {}
    offsets: dict[str, np.ndarray] = {}
    for number, joint in enumerate(JOINTS):
        above = PARENTS[joint]
        frame = bound[above] if above else Rotation.identity()
        position = turn.apply(PLACES[joint] - (PLACES[above] if above else 0.0)) * size / metres
        offsets[joint], bound[joint] = frame.inv().apply(position), frame * own[joint]
        values = [
            ("Lcl Translation", offsets[joint]),
            ("PreRotation", _euler(own[joint], "xyz")),
            ("Lcl Rotation", random.uniform(-40, 40, 3) * posed),
        ]
        body = _properties(*values, order=number % 6)
        limbs[joint] = document.add("Model", f"Model::{joint}", "LimbNode", body, limbs[above] if above else top)
        attribute = 'TypeFlags: "Skeleton"'
        document.add("NodeAttribute", f"NodeAttribute::{joint}", "LimbNode", f"\t\t{attribute}", limbs[joint])
    tracks = [_add_take(document, random, take, limbs, offsets, frames, rate) for take in takes]
    positions = _pose(*tracks[0], own, offsets, turn, metres / size) if tracks else np.zeros((0, len(JOINTS), 3))
    rests = np.array([PLACES[joint] for joint in JOINTS])
    vertices = _add_skin(document, name, limbs, bound, turn, metres, scale[0], only) if skin else np.zeros((0, 3))
    return MadeFbx(positions, rests, vertices)


def _euler(turn: Rotation, order: str) -> np.ndarray:
    """Degrees about x, y and z, of turns about fixed axes in an order."""
    angles = turn.as_euler(order, degrees=True)
    return np.array([angles[order.index(axis)] for axis in "xyz"])


def _properties(*values, order: int = 0) -> str:
    kinds = {"PreRotation": ("Vector3D", "Vector", "")}
    lines = ["\t\tVersion: 232", "\t\tProperties70:  {"]
    lines += [f'\t\t\tP: "RotationActive", "bool", "", "",1\n\t\t\tP: "RotationOrder", "enum", "", "",{order}']
    for name, numbers in values:
        given = '", "'.join(kinds.get(name, (name, "", "A")))
        lines.append(f'\t\t\tP: "{name}", "{given}",{_list(numbers)}')
    return "\n".join([*lines, "\t\t}"])


def _list(numbers) -> str:
    return ",".join(format(float(number), ".17g") for number in np.ravel(numbers))


def _table(name: str, numbers, form: str = ".17g") -> str:
    flat = np.ravel(numbers).tolist()
    return f"\t\t{name}: *{len(flat)} {{\n\t\t\ta: {','.join(format(n, form) for n in flat)}\n\t\t}}"


def _add_take(document, random, take, limbs, offsets, frames, rate):
    """Keys of all rotations and of the hips' place; angles (frames, joints, 3), degrees, and the hips' places."""
    stop = (frames - 1) * TICKS // rate
    times = [frame * TICKS // rate for frame in range(frames)]
    ends = {"LocalStart": 0, "LocalStop": stop, "ReferenceStart": 0, "ReferenceStop": stop}
    lines = [f'\t\t\tP: "{name}", "KTime", "Time", "",{ticks}' for name, ticks in ends.items()]
    body = "\n".join(["\t\tProperties70:  {", *lines, "\t\t}"])
    stack = document.add("AnimationStack", f"AnimStack::{take}", "", body, None)
    layer = document.add("AnimationLayer", "AnimLayer::Base", "", "", stack)
    angles = random.uniform(-50, 50, (frames, len(JOINTS), 3))
    ways = offsets["hips"] + random.uniform(-30, 30, (frames, 3))
    tracks = [(joint, "R", "Lcl Rotation", angles[:, k]) for k, joint in enumerate(JOINTS)]
    for joint, letter, role, values in [("hips", "T", "Lcl Translation", ways), *tracks]:
        node = document.add("AnimationCurveNode", f"AnimCurveNode::{letter}", "", "", layer)
        document.link(node, limbs[joint], role)
        for axis, column in zip("XYZ", values.T, strict=True):
            keys = [_table("KeyTime", times, "d"), _table("KeyValueFloat", column), _table("KeyAttrFlags", [4], "d")]
            keys += [_table("KeyAttrDataFloat", [0, 0, 0, 0], "d"), _table("KeyAttrRefCount", [frames], "d")]
            document.add("AnimationCurve", "AnimCurve::", "", "\n".join(keys), node, f"d|{axis}")
    return angles, ways


def _pose(angles, ways, own, offsets, turn, metres) -> np.ndarray:
    """Where the limbs are, (frames, joints, 3), metres and Y up."""
    frames = len(angles)
    worlds, positions = dict[str, Rotation](), dict[str, np.ndarray]()
    for number, joint in enumerate(JOINTS):
        order = _ORDERS[number % 6]
        columns = ["xyz".index(axis) for axis in order]
        spins = own[joint] * Rotation.from_euler(order, angles[:, number][:, columns], degrees=True)
        above = PARENTS[joint]
        worlds[joint] = worlds[above] * spins if above else spins
        offset = np.tile(offsets[joint], (frames, 1))
        positions[joint] = positions[above] + worlds[above].apply(offset) if above else ways
    stacked = np.stack([positions[joint] for joint in JOINTS], axis=1) * metres
    return turn.inv().apply(stacked.reshape(-1, 3)).reshape(stacked.shape)


def _add_skin(document, name, limbs, bound, turn, metres, size, only) -> np.ndarray:
    parts = [part for part in build_parts(1) if part.name in only]
    counts = np.cumsum([0, *(len(part.vertices) for part in parts)])
    points = np.concatenate([part.vertices for part in parts])
    faces = np.concatenate([part.faces + start for part, start in zip(parts, counts, strict=False)])
    ends = np.concatenate([faces[:, :2], ~faces[:, 2:]], axis=1)
    body = [_table("Vertices", turn.apply(points) / metres), _table("PolygonVertexIndex", ends, "d")]
    node = document.add("Model", f"Model::{name}_body", "Mesh", _properties())
    geometry = document.add("Geometry", f"Geometry::{name}_body", "Mesh", "\n".join(body), node)
    deformer = document.add("Deformer", "Deformer::skin", "Skin", "", geometry)
    for joint in JOINTS:
        shares = np.concatenate([part.weights.get(joint, np.zeros(len(part.vertices))) for part in parts])
        link = np.eye(4)
        link[:3, :3], link[:3, 3] = bound[joint].as_matrix() * size, turn.apply(PLACES[joint]) / metres
        used = np.flatnonzero(shares)
        tables = [_table("Indexes", used, "d"), _table("Weights", shares[used])] if len(used) else []
        tables += [_table("Transform", np.linalg.inv(link).T), _table("TransformLink", link.T)]
        cluster = document.add("Deformer", f"SubDeformer::{joint}", "Cluster", "\n".join(tables), deformer)
        document.link(limbs[joint], cluster)
    return points
