"""ASF and AMC pairs of a person in a T-pose, drawn from a seed, and where their bones are straight from the definition.

Shares no code with the reader: matrices by numpy, frame by frame and bone by bone.
"""

from dataclasses import dataclass, field, replace

import numpy as np

from mapctl import rotations

# Name, parent, direction, length in metres and the turns it has; in a T-pose facing +Z, left toward +X.
_LEG = (
    ("hipjoint", "root", (0.6, -0.8, 0), 0.11, ""),
    ("femur", "hipjoint", (0.1, -0.995, 0), 0.42, "xyz"),
    ("tibia", "femur", (0.1, -0.99, 0.1), 0.41, "x"),
    ("foot", "tibia", (0.1, -0.5, 0.86), 0.15, "xz"),
    ("toes", "foot", (0, -0.1, 0.99), 0.07, "x"),
)
_ARM = (
    ("clavicle", "thorax", (0.9, 0.4, 0), 0.17, "yz"),
    ("humerus", "clavicle", (1, 0, 0), 0.29, "xyz"),
    ("radius", "humerus", (1, 0, 0), 0.18, "x"),
    ("wrist", "radius", (1, 0, 0), 0.09, "y"),
    ("hand", "wrist", (1, 0, 0), 0.08, "xz"),
)
_SPINE = (
    ("lowerback", "root", (0, 1, -0.1), 0.12, "xyz"),
    ("thorax", "lowerback", (0, 1, 0.1), 0.22, "zyx"),
    ("head", "thorax", (0, 1, 0.1), 0.2, "yxz"),
)
_UNIT = 0.0254 / 0.45


@dataclass(frozen=True)
class Bone:
    """One bone as the ASF says it, lengths in the file's unit."""

    name: str
    parent: str
    direction: np.ndarray
    length: float
    axis: np.ndarray
    """Degrees about x, y, z."""
    order: str
    """Which of them comes first, as `zxy`."""
    dof: str
    """Axes of its turns in the file's order."""


@dataclass(frozen=True)
class Pair:
    """A skeleton and a take."""

    bones: tuple[Bone, ...]
    root_order: str
    """Axes of the root's turns."""
    frames: tuple[dict[str, np.ndarray], ...]
    """Values of each frame by the bones that it holds, degrees and file units."""
    degrees: bool = True
    orientation: np.ndarray = field(default_factory=lambda: np.zeros(3))
    position: np.ndarray = field(default_factory=lambda: np.zeros(3))
    length: float = 0.45
    full: bool = True

    def asf(self) -> str:
        """The text of the skeleton's file."""
        root = " ".join(["TX TY TZ", *(f"R{axis.upper()}" for axis in self.root_order)])
        head = (
            "# made for tests\n:version 1.10\n:name VICON\n:units\n  mass 1.0\n"
            f"  length {self.length}\n  angle {'deg' if self.degrees else 'rad'}\n"
            ":documentation\n   a line with a word: or two # and a mark\n"
            f":root\n   order {root}\n   axis ZXY\n   position {_text(self.position)}\n"
            f"   orientation {_text(self._angles(self.orientation))}\n:bonedata\n"
        )
        tree: dict[str, list[str]] = {}
        for bone in self.bones:
            tree.setdefault(bone.parent, []).append(bone.name)
        lines = [f"    {name} {' '.join(below)}" for name, below in tree.items()]
        bones = "".join(self._bone(number, bone) for number, bone in enumerate(self.bones, start=1))
        return "\n".join([f"{head}{bones}:hierarchy\n  begin", *lines, "  end", ""])

    def _bone(self, number: int, bone: Bone) -> str:
        dof = ""
        if bone.dof:
            ranges = "\n            ".join("(-160.0 20.0)" if k else "(-inf inf)" for k in range(len(bone.dof)))
            dof = f"     dof {' '.join(f'r{axis}' for axis in bone.dof)}\n     limits {ranges}\n"
        axis = f"{_text(self._angles(bone.axis))} {bone.order.upper()}"
        return (
            f"  begin\n     id {number}\n     name {bone.name}\n     direction {_text(bone.direction)}\n"
            f"     length {bone.length!r}\n     axis {axis}\n{dof}  end\n"
        )

    def amc(self) -> str:
        """The text of the take's file."""
        head = ["#!OML:ASF", *([":FULLY-SPECIFIED"] if self.full else []), ":DEGREES" if self.degrees else ":RADIANS"]
        for number, frame in enumerate(self.frames, start=1):
            head.append(str(number))
            for name, values in frame.items():
                values = values if name == "root" else self._angles(values)
                if name == "root":
                    values = np.concatenate([values[:3], self._angles(values[3:])])
                head.append(f"{name} {_text(values)}")
        return "\n".join([*head, ""])

    def write(self, folder, subject="walk", take="walk"):
        """Both files; the take's path."""
        (folder / f"{subject}.asf").write_text(self.asf())
        (folder / f"{take}.amc").write_text(self.amc())
        return folder / f"{take}.amc"

    def _angles(self, degrees: np.ndarray) -> np.ndarray:
        return degrees if self.degrees else np.deg2rad(degrees)

    def positions(self) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
        """Starts and ends of the bones by name, (frames, 3) metres, by the definition."""
        starts, ends, held = {}, {}, {"root": np.zeros(6)} | {bone.name: np.zeros(len(bone.dof)) for bone in self.bones}
        for frame in self.frames:
            held |= frame
            frame_starts, frame_ends = self._frame(held)
            for name in frame_starts:
                starts.setdefault(name, []).append(frame_starts[name] * 0.0254 / self.length)
                ends.setdefault(name, []).append(frame_ends[name] * 0.0254 / self.length)
        return {name: np.array(v) for name, v in starts.items()}, {name: np.array(v) for name, v in ends.items()}

    def _frame(self, values):
        pre = fixed(self.orientation, "zxy")
        turns = dict(zip(self.root_order, values["root"][3:], strict=True))
        motion = fixed(np.array([turns.get(axis, 0.0) for axis in "xyz"]), self.root_order)
        world = {"root": pre @ motion @ pre.T}
        starts = {"root": self.position + values["root"][:3]}
        ends = dict(starts)
        for bone in self.bones:
            turns = dict(zip(bone.dof, values[bone.name], strict=True))
            frame = fixed(bone.axis, bone.order)
            turn = fixed(np.array([turns.get(axis, 0.0) for axis in "xyz"]), bone.dof)
            world[bone.name] = world[bone.parent] @ frame @ turn @ frame.T
            starts[bone.name] = ends[bone.parent]
            ends[bone.name] = starts[bone.name] + world[bone.name] @ (bone.direction * bone.length)
        return starts, ends


def fixed(degrees: np.ndarray, order: str) -> np.ndarray:
    """Matrix of turns by `degrees` (about x, y, z) about fixed axes, the first of `order` first."""
    result = np.eye(3)
    for axis in order:
        k = "xyz".index(axis)
        cos, sin = np.cos(np.deg2rad(degrees[k])), np.sin(np.deg2rad(degrees[k]))
        turn = np.eye(3)
        i, j = (k + 1) % 3, (k + 2) % 3
        turn[i, i], turn[j, j], turn[i, j], turn[j, i] = cos, cos, -sin, sin
        result = turn @ result
    return result


def pair(frames: int = 4, *, seed: int = 0, missing: float = 0.0, **changes) -> Pair:
    """A person whose every joint moves; `missing` is the part of the bones that a frame leaves out."""
    random = np.random.default_rng(seed)
    bones = _person(random)
    moving = [bone for bone in bones if bone.dof]
    root_order = "".join(random.permutation(list("xyz")))
    taken = []
    for _ in range(frames):
        frame = {"root": np.concatenate([random.normal(0, 10, 3), random.uniform(-180, 180, 3)])}
        frame |= {b.name: random.uniform(-70, 70, len(b.dof)) for b in moving if random.random() >= missing}
        taken.append(frame)
    result = Pair(bones, root_order, tuple(taken), full=missing == 0)
    return replace(result, **changes)


def _person(random: np.random.Generator) -> tuple[Bone, ...]:
    found = [("", bone, 1) for bone in _SPINE]
    found += [(side, bone, sign) for side, sign in (("l", 1), ("r", -1)) for bone in (*_LEG, *_ARM)]
    bones = []
    for side, (name, parent, direction, length, dof), sign in found:
        vector = np.array(direction) * (sign, 1, 1)
        above = parent if parent in ("root", "thorax", "lowerback") else side + parent
        order = "".join(random.permutation(list("xyz")))
        bones.append(
            Bone(
                side + name,
                above,
                vector / np.linalg.norm(vector),
                round(length / _UNIT, 6),
                random.uniform(-90, 90, 3).round(3),
                order,
                dof,
            )
        )
    return tuple(bones)


def _text(values: np.ndarray) -> str:
    return " ".join(repr(float(value)) for value in values)


def ends_of(motion):
    """Where the End Sites are, (frames, 3) by joint name."""
    positions, turns = motion.joint_positions(), motion.joint_rotations()
    return {
        name: (
            positions[:, j] + rotations.rotate(turns[:, j], positions.new_tensor(site).expand(len(positions), 3))
        ).numpy()
        for name, site in motion.skeleton.end_offsets.items()
        for j in [motion.skeleton.index(name)]
    }


def assert_same_places(motion, given):
    """Joints at the bones' starts, End Sites at the last bones' ends."""
    starts, ends = given.positions()
    positions = motion.joint_positions().numpy()
    assert set(motion.skeleton.names) == set(starts)
    for joint, name in enumerate(motion.skeleton.names):
        np.testing.assert_allclose(positions[:, joint], starts[name], atol=1e-9, err_msg=name)
    leaves = {bone.name for bone in given.bones} - {bone.parent for bone in given.bones}
    assert set(motion.skeleton.end_offsets) == leaves
    for name, position in ends_of(motion).items():
        np.testing.assert_allclose(position, ends[name], atol=1e-9, err_msg=name)
