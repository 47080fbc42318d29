"""A person for any skeleton: one skinned mesh around its bones, left sleeve and shoe blue, right ones orange."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import scipy
import torch

from mapctl import rotations
from mapctl.errors import MapctlError
from mapctl.joint_names import Part, Role, Side
from mapctl.mesh import colours
from mapctl.mesh.anatomy import Anatomy, Foot, Limb
from mapctl.mesh.character_mesh import CharacterMesh
from mapctl.mesh.isosurface import Solid, mesh_union
from mapctl.mesh.primitives import Array, Surface, unit
from mapctl.motion import Motion
from mapctl.skeleton import CANONICAL, TOE_REST_HEIGHT, Skeleton

_X, _Y, _Z = np.eye(3)
# Sections by part, metres for a person of 1.75 m: share of the bone, half width, half depth, offsets along both.
# Widths of arms and hands are along the ground, of all else to the left.
_SECTIONS = {
    Part.NECK: [(-0.3, 0.062, 0.060, 0, 0), (0.4, 0.054, 0.056, 0, 0.004), (1.2, 0.052, 0.056, 0, 0.008)],
    Part.UPPER_ARM: [
        (-0.06, 0.054, 0.050, 0, 0),
        (0.12, 0.060, 0.056, 0, 0),
        (0.45, 0.050, 0.047, 0.003, 0),
        (0.75, 0.043, 0.042, 0, 0),
        (1.0, 0.040, 0.039, 0, 0),
    ],
    Part.LOWER_ARM: [
        (0.0, 0.040, 0.039, 0, 0),
        (0.22, 0.044, 0.041, 0, 0),
        (0.65, 0.034, 0.029, 0, 0),
        (1.0, 0.030, 0.022, 0, 0),
    ],
    Part.UPPER_LEG: [
        (-0.08, 0.082, 0.080, 0, 0),
        (0.10, 0.086, 0.090, 0, 0),
        (0.45, 0.075, 0.080, 0, 0.006),
        (0.85, 0.058, 0.062, 0, 0.004),
        (1.0, 0.053, 0.057, 0, 0.002),
    ],
    Part.LOWER_LEG: [
        (0.0, 0.052, 0.056, 0, 0.002),
        (0.12, 0.051, 0.055, 0, -0.006),
        (0.30, 0.055, 0.059, 0, -0.014),
        (0.60, 0.043, 0.046, 0, -0.008),
        (0.88, 0.034, 0.038, 0, -0.004),
        (1.0, 0.034, 0.042, 0, -0.004),
    ],
}
_TRUNK = [  # from between the hip joints to the neck
    (-0.10, 0.085, 0.085, 0, -0.010),
    (0.02, 0.150, 0.108, 0, -0.012),
    (0.14, 0.160, 0.108, 0, -0.008),
    (0.38, 0.136, 0.094, 0, 0.004),
    (0.62, 0.150, 0.106, 0, 0.004),
    (0.80, 0.160, 0.112, 0, 0.006),
    (0.93, 0.125, 0.088, 0, -0.006),
    (1.02, 0.062, 0.062, 0, -0.008),
]
_PALM = [  # from the wrist, a hand's length along it
    (0.0, 0.030, 0.022, 0, 0),
    (0.20, 0.037, 0.020, 0, 0),
    (0.48, 0.043, 0.016, 0, 0),
    (0.75, 0.039, 0.013, 0, -0.004),
    (0.90, 0.030, 0.013, 0, -0.009),
    (0.98, 0.022, 0.012, 0, -0.012),
]
_HAND = 0.185
_HEAD = (  # centre ahead of and above the head joint, and half axes to the left, up and ahead
    ((0.0, 0.122, 0.002), (0.076, 0.088, 0.094)),  # cranium
    ((0.0, 0.058, 0.036), (0.056, 0.068, 0.056)),  # face
    ((0.0, 0.018, 0.062), (0.030, 0.022, 0.030)),  # chin
    ((0.0, 0.072, 0.104), (0.010, 0.022, 0.018)),  # nose
    ((0.078, 0.088, -0.002), (0.008, 0.028, 0.016)),  # ears
    ((-0.078, 0.088, -0.002), (0.008, 0.028, 0.016)),
)
_SHOE = [  # from the heel to the ball, along the sole
    (0.0, 0.033, 0.042, 0, 0),
    (0.35, 0.035, 0.042, 0, 0),
    (0.75, 0.043, 0.038, 0, 0.004),
    (1.0, 0.046, 0.034, 0, 0.006),
]
_TOE = [(0.0, 0.046, 0.034, 0, 0), (0.5, 0.043, 0.028, 0, 0.004), (1.0, 0.034, 0.020, 0, 0.010)]
_GRID = (0.023, 0.011)  # metres between the lines of the grid, and where hands, feet and head are
_MOST_LINES = 120  # of the coarse grid along an axis, whatever the proportions
_SMOOTHINGS, _LEAST_SHARE = 16, 0.05  # of the joints' shares over the mesh, each over a triangle's edge
_CARRIERS = 4  # joints a vertex, which is what viewers of glTF take
_SKIN, _HAIR, _TROUSERS = (colours.rgb(code) for code in (colours.SKIN, colours.HAIR, colours.TROUSERS))
_SIDES = {Side.LEFT: (1.0, colours.rgb(colours.LEFT)), Side.RIGHT: (-1.0, colours.rgb(colours.RIGHT))}
_STICKS = {
    **{Part.HIPS: 0.10, Part.TORSO: 0.11, Part.SHOULDER: 0.055, Part.NECK: 0.055, Part.HEAD: 0.09},
    **{Part.UPPER_ARM: 0.045, Part.LOWER_ARM: 0.035, Part.HAND: 0.035, Part.FINGER: 0.01},
    **{Part.UPPER_LEG: 0.07, Part.LOWER_LEG: 0.045, Part.FOOT: 0.045, Part.TOES: 0.045},
}
"""Radii of bones as sticks and as they cast shadows, metres."""


@dataclass(frozen=True, eq=False)
class Piece:
    """A solid of the body, its colour, and the joints that carry it."""

    solid: Solid
    rgb: Array
    """(3,) sRGB."""
    joints: Sequence[tuple[float, int]]
    """Rising shares of the axis, and the joint from each on; below the first, too, the first."""


@dataclass(frozen=True, eq=False)
class Border:
    """A plane beyond which what has one colour has another one, in some pieces."""

    pieces: frozenset[int]
    """Numbers of the pieces; those that have another colour keep it."""
    point: Array
    """(3,) on the plane, metres."""
    normal: Array
    """(3,) unit."""
    old: Array
    """(3,) sRGB before it."""
    new: Array
    """(3,) sRGB beyond it."""


def build_skin(motion: Motion, colour: str = "slate") -> CharacterMesh:
    """Build the body of a motion, with the hips at the origin; its frames show when feet are flat and how joints turn
    on average, so it should hold more than one step.

    `colour` is the shirt's: a name of `colours.ACTORS` or `#rrggbb`; RequestError otherwise.
    """
    return _Builder(Anatomy(motion), colours.rgb(colour)).build()


class _Builder:
    """Builds a body in the bind pose of its anatomy, solid by solid."""

    def __init__(self, anatomy: Anatomy, colour: Array):
        self.anatomy, self.colour, self.pieces = anatomy, colour, list[Piece]()
        self.borders = list[Border]()
        self._trousers = colours.blend_colours(colour, _TROUSERS, 0.8)
        self.place, self.frames = anatomy.bind_pose
        self.low = anatomy.scale
        self.high = self._measure_upper_body()
        legs = [limb for limb in anatomy.limbs if limb.parts[0] is Part.UPPER_LEG]
        top = next((j for part in (Part.NECK, Part.HEAD) if (j := anatomy.find(part)) is not None), None)
        if top is None or len(legs) < 2:
            self._add_bones()
            return
        self._add_trunk(top, legs)
        self._add_head()
        for leg in legs:
            self._add_leg(leg)
        for arm in anatomy.limbs:
            if arm.parts[0] is Part.UPPER_ARM:
                self._add_arm(arm, top)
        self._dress(top)
        for foot in anatomy.feet:
            self._add_shoe(foot)

    def build(self) -> CharacterMesh:
        """Mesh the solids, colour the mesh, and share its vertices out to the joints."""
        solids, count = [piece.solid for piece in self.pieces], self.anatomy.joints
        vertices, normals, faces = mesh_union(solids, self._lay_grid(), self.low)
        nearest = np.argmin([solid.distance(vertices) for solid in solids], axis=0)
        joint = np.zeros(len(vertices), int)
        for number, piece in enumerate(self.pieces):
            starts, joints = zip(*piece.joints, strict=True)
            band = np.searchsorted(starts, piece.solid.share(vertices[nearest == number]), side="right") - 1
            joint[nearest == number] = np.array(joints)[np.maximum(band, 0)]
        carriers, weights = _smooth_shares(joint, faces, count)
        vertices, rgb = self._colour(vertices, faces, nearest)
        # An edge between colours is sharp where each has vertices of its own.
        alike = np.column_stack([faces.reshape(-1), np.repeat(rgb, 3, axis=0)])
        kept, corners = np.unique(alike, axis=0, return_inverse=True)
        own = kept[:, 0].astype(int)
        return CharacterMesh(
            vertices=vertices[own],
            normals=normals[own],
            faces=corners.reshape(-1, 3),
            rgba=np.column_stack([kept[:, 1:], np.ones(len(kept))]),
            joints=carriers[own],
            weights=weights[own],
            rest=self.place[:count],
            frames=self.frames,
        )

    def _colour(self, vertices: Array, faces: Array, nearest: Array) -> tuple[Array, Array]:
        """Return vertices (n, 3), those near a border moved onto it, and the faces' colours (m, 3)."""
        piece, vertices = nearest[faces[:, 0]], vertices.copy()
        rgb = np.array([one.rgb for one in self.pieces])[piece]
        edges = faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
        for border in self.borders:
            height = (vertices - border.point) @ border.normal
            crossing = edges[height[edges[:, 0]] * height[edges[:, 1]] < 0]
            nearer = crossing[np.arange(len(crossing)), np.abs(height[crossing]).argmin(axis=1)]
            close = np.unique(nearer[np.isin(nearest[nearer], list(border.pieces))])
            vertices[close] -= height[close, None] * border.normal
            beyond = (vertices[faces].mean(axis=1) - border.point) @ border.normal > 1e-4 * self.low
            rgb[beyond & (rgb == border.old).all(axis=1) & np.isin(piece, list(border.pieces))] = border.new
        return vertices, rgb

    def _add(
        self,
        joint: int | Sequence[tuple[float, int]],
        start: Array,
        end: Array,
        rows: Sequence[Sequence[float]],
        size: float,
        across: Array,
        rgb: Array,
        floor: float = -np.inf,
    ) -> int:
        """Add a solid with sections `size` times as large; return its number."""
        solid = Solid(start, end, across, np.array(rows, float) * [1, size, size, size, size], floor)
        self.pieces.append(Piece(solid, rgb, [(0.0, joint)] if isinstance(joint, int) else joint))
        return len(self.pieces) - 1

    def _split(self, pieces: Sequence[int], point: Array, normal: Array, old: Array, new: Array) -> None:
        self.borders.append(Border(frozenset(pieces), point, unit(normal), old, new))

    def _measure_upper_body(self) -> float:
        """Return the scale of trunk, arms and head: that of trunk and arms, but not far from that of the legs."""
        neck = self.anatomy.find(Part.NECK)
        found = [] if neck is None else [np.linalg.norm(self.place[neck] - self.place[self.anatomy.hips]) / 0.51]
        for limb in self.anatomy.limbs:
            if limb.parts[0] is Part.UPPER_ARM:
                found.append(np.linalg.norm(self.place[limb.joints[-1]] - self.place[limb.joints[0]]) / 0.54)
        return float(np.clip(np.mean(found or [self.low]), 0.8 * self.low, 1.25 * self.low))

    def _add_trunk(self, top: int, legs: Sequence[Limb]) -> None:
        place, base = self.place, self.place[[leg.joints[0] for leg in legs]].mean(axis=0)
        chain, hips = self.anatomy.find_path(top), self.anatomy.hips
        chain = chain[: chain.index(hips) + 1] if hips in chain else chain
        along = place[top] - base
        shares = [(float((place[j] - base) @ along / (along @ along)), j) for j in reversed(chain)]
        trunk = self._add(shares, base, place[top], _TRUNK, self.high, _X, self.colour)
        self._split([trunk], base + 0.24 * along, -along, self.colour, self._trousers)
        head = self.anatomy.find(Part.HEAD)
        if head is not None and head != top:
            self._add(top, place[top], place[head], _SECTIONS[Part.NECK], self.high, _X, self.colour)

    def _dress(self, top: int) -> None:
        """Draw the collar, and where hair begins."""
        every, head = range(len(self.pieces)), self.anatomy.find(Part.HEAD)
        collar = self.place[top] + np.array([0.0, 0.036, 0.0]) * self.high
        self._split(every, collar, np.array([0.0, 1.0, 0.3]), self.colour, _SKIN)
        if head is not None:
            line = self.place[head] + np.array([0.0, 0.085, 0.0]) * self.high
            self._split(every, line, np.array([0.0, 1.0, -1.15]), _SKIN, _HAIR)

    def _add_ball(self, joint: int, centre: Array, axes: Sequence[float], size: float, rgb: Array) -> None:
        """Add an ellipsoid with half axes across, up and ahead."""
        wide, tall, deep = axes
        half = max(tall - (wide * deep) ** 0.5, 1e-3) * size * _Y
        self._add(joint, centre - half, centre + half, [(0, wide, deep, 0, 0), (1, wide, deep, 0, 0)], size, _X, rgb)

    def _add_head(self) -> None:
        head = self.anatomy.find(Part.HEAD)
        if head is not None:
            for centre, axes in _HEAD:
                self._add_ball(head, self.place[head] + np.array(centre) * self.high, axes, self.high, _SKIN)

    def _add_leg(self, leg: Limb) -> None:
        hip, knee, ankle = self._find_ends(leg)
        first, own, size = leg.joints[0], _SIDES[leg.side][1], self.low
        self._add_ball(first, hip + np.array([0.0, -0.005, -0.042]) * size, (0.080, 0.085, 0.080), size, self._trousers)
        self._add(first, hip, knee, _SECTIONS[Part.UPPER_LEG], size, -_X, self._trousers)
        shin = self._add(leg.middle, knee, ankle, _SECTIONS[Part.LOWER_LEG], size, -_X, self._trousers)
        self._split([shin], knee + 0.4 * (ankle - knee), ankle - knee, self._trousers, own)

    def _add_arm(self, arm: Limb, top: int) -> None:
        shoulder, elbow, wrist = self._find_ends(arm)
        (sign, own), size, first = _SIDES[arm.side], self.high, arm.joints[0]
        inner = self.place[top] + np.array([sign * 0.03, -0.035, -0.01]) * size
        rows = [(0.0, 0.050, 0.034, 0, 0), (1.0, 0.052, 0.048, 0, 0)]
        self._add(self.anatomy.points.parents[first], inner, shoulder, rows, size, _Z, self.colour)
        upper = self._add(first, shoulder, elbow, _SECTIONS[Part.UPPER_ARM], size, sign * _Z, self.colour)
        self._split([upper], (shoulder + elbow) / 2, elbow - shoulder, self.colour, own)
        lower = self._add(arm.middle, elbow, wrist, _SECTIONS[Part.LOWER_ARM], size, sign * _Z, own)
        self._split([lower], elbow + 0.88 * (wrist - elbow), wrist - elbow, own, _SKIN)
        self._add_hand(arm)

    def _find_ends(self, limb: Limb) -> Array:
        return self.place[[limb.joints[0], limb.middle, limb.joints[-1]]]

    def _add_hand(self, arm: Limb) -> None:
        """Add a palm, and a thumb and fingers in one where the rig has no fingers of its own."""
        hand, size, (sign, _) = arm.joints[-1], self.high, _SIDES[arm.side]
        wrist, points = self.place[hand], self.anatomy.points
        carrier = hand if hand < self.anatomy.joints else arm.middle
        fingers = [k for k, role in enumerate(points.roles) if role == Role(arm.side, Part.FINGER)]
        rows = _PALM[:3] if len(fingers) > 2 else _PALM
        self._add(carrier, wrist, wrist + _HAND * size * arm.direction, rows, size, sign * _Z, _SKIN)
        if len(fingers) > 2:
            for point in fingers:
                parent = points.parents[point]
                if points.roles[parent].part is Part.FINGER:
                    self._add_capsule(parent, point, 0.009, _SKIN)
        else:
            root, tip = ((a * arm.direction + b * _Z) * size + wrist for a, b in ((0.035, 0.020), (0.095, 0.062)))
            self._add(carrier, root, tip, [(0, 0.016, 0.016, 0, 0), (1, 0.011, 0.011, 0, 0)], size, _Y, _SKIN)

    def _add_shoe(self, foot: Foot) -> None:
        size, own = self.low, _SIDES[foot.side][1]
        ankle, ball = self.place[foot.ankle], self.place[foot.ball]
        floors = ankle[1] - foot.heights[0], ball[1] - foot.heights[1]
        toe = foot.ball if foot.ball < self.anatomy.joints else foot.ankle
        heel = np.array([ankle[0], floors[0] + 0.040 * size, ankle[2] - 0.030 * size])
        front = np.array([ball[0], floors[1] + 0.032 * size, ball[2]])
        self._add(foot.ankle, heel, front, _SHOE, size, _X, own, floors[0])
        instep = [(0, 0.036, 0.040, 0, 0), (1, 0.036, 0.024, 0, 0)]
        self._add(foot.ankle, ankle, ankle + 0.8 * (front - ankle), instep, size, _X, own, floors[0])
        reach = 0.05 * size if foot.tip is None else max(self.place[foot.tip][2] - ball[2] - 0.012 * size, 0.03 * size)
        self._add(toe, front, front + np.array([0, -0.008 * size, reach]), _TOE, size, _X, own, floors[1])

    def _add_bones(self) -> None:
        """Add thin capsules for all bones, of a rig that is not recognised as a person's."""
        hips, parents, extent = self.anatomy.hips, self.anatomy.points.parents, np.ptp(self.place, axis=0).max()
        self.low = extent / 1.7 if extent > 0 else self.low
        for point, parent in [(k, p) for k, p in enumerate(parents) if p >= hips] or [(hips, hips)]:
            self._add_capsule(parent, point, 0.02 if extent > 0 else 0.09, self.colour)

    def _add_capsule(self, joint: int, point: int, radius: float, rgb: Array) -> None:
        rows = [(0, radius, radius, 0, 0), (1, radius, radius, 0, 0)]
        self._add(joint, self.place[joint], self.place[point], rows, self.low, _X, rgb)

    def _lay_grid(self) -> list[Array]:
        """Return the grid's lines along x, y and z: finer where hands, feet and head are."""
        low, high = (np.array(corner) for corner in zip(*(piece.solid.bounds for piece in self.pieces), strict=True))
        extent = (high.max(axis=0) - low.min(axis=0)).max()
        coarse, fine = (step * max(self.low, extent / _MOST_LINES / _GRID[0]) for step in _GRID)
        parts = [self.anatomy.points.roles[piece.joints[0][1]].part for piece in self.pieces]
        small = np.array([part in (Part.HAND, Part.FINGER, Part.HEAD, Part.TOES, Part.FOOT) for part in parts])
        lines = []
        for axis in range(3):
            at, end = [low[:, axis].min() - 3 * coarse], high[:, axis].max() + 3 * coarse
            while at[-1] < end:
                inside = small & (low[:, axis] - coarse < at[-1]) & (at[-1] < high[:, axis])
                at.append(at[-1] + (fine if inside.any() else coarse))
            lines.append(np.array(at))
        return lines


def _smooth_shares(joint: Array, faces: Array, count: int) -> tuple[Array, Array]:
    """Return the joints (n, 4) that carry vertices, and their shares: those of the vertices around, again and again."""
    n, pairs = len(joint), np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    near = scipy.sparse.csr_array((np.ones(len(pairs)), pairs.T), shape=(n, n)) + scipy.sparse.eye_array(n)
    near = near.multiply(1 / near.sum(axis=1)[:, None]).tocsr()
    shares = np.eye(count)[joint]
    for _ in range(_SMOOTHINGS):
        shares = near @ shares
    carriers = np.argsort(-shares, axis=1, kind="stable")[:, :_CARRIERS]
    weights = np.take_along_axis(shares, carriers, axis=1)
    weights[weights < _LEAST_SHARE] = 0.0
    return carriers, weights / weights.sum(axis=1, keepdims=True)


class Body:
    """The mesh of a character moved by its joints, over a whole motion, and the anatomy below it."""

    def __init__(self, motion: Motion, mesh: CharacterMesh, anatomy: Anatomy, colour: Array):
        """`motion` is on the joints of the mesh, frame by frame that of `anatomy`, and `colour` (3,) that of its bones
        in the middle, where bones are drawn. MapctlError where the mesh has other joints."""
        if motion.num_joints != len(mesh.rest) or motion.num_frames != len(anatomy.rotations):
            found = f"{motion.num_joints} joints and {motion.num_frames} frames"
            raise MapctlError(f"a mesh of {len(mesh.rest)} joints and {len(anatomy.rotations)} frames got {found}")
        self.mesh, self.anatomy, self.colour = mesh, anatomy, colour
        self._positions = motion.joint_positions().numpy()
        self._turns = rotations.to_matrix(motion.joint_rotations()).numpy()

    @staticmethod
    def of(motion: Motion, colour: Array) -> "Body":
        """Build the body of a person; its shirt has the colour (3,)."""
        builder = _Builder(Anatomy(motion), colour)
        return Body(motion, builder.build(), builder.anatomy, colour)

    @property
    def num_frames(self) -> int:
        """Frames of the motion."""
        return len(self._positions)

    @property
    def seen(self) -> Array:
        """Positions (frames, n, 3) of its bones, and of the vertices that are outermost at rest, metres."""
        vertices = self.mesh.vertices
        outer = np.concatenate([vertices.argmin(axis=0), vertices.argmax(axis=0)])
        joint = self.mesh.joints[outer, self.mesh.weights[outer].argmax(axis=1)]
        turned = np.einsum("fnab,nb->fna", self._turns[:, joint], self.mesh.to_joints(vertices[outer], joint))
        return np.concatenate([self.anatomy.seen, self._positions[:, joint] + turned], axis=1)

    def surface(self, frame: int) -> Surface:
        """Return the mesh in one frame; it may be open, as clothes and hair are."""
        vertices, normals = self.mesh.pose(self._positions[frame], self._turns[frame])
        return Surface(vertices, self.mesh.faces, self.mesh.rgba, normals)

    def sticks(self, frame: int) -> tuple[Array, Array, Array]:
        """Return all bones in one frame: ends (n, 2, 3) and radii (n,) in metres, colours (n, 3) sRGB."""
        ends, radii, rgb = self._sticks
        return self.anatomy.points.world[frame, ends], radii, rgb

    @cached_property
    def _sticks(self) -> tuple[Array, Array, Array]:
        points, hips = self.anatomy.points, self.anatomy.hips
        pairs = [(p, k) for k, p in enumerate(points.parents) if p >= hips] or [(hips, hips)]
        roles = [points.roles[parent] for parent, _ in pairs]
        radii = np.array([_STICKS.get(role.part, 0.02) for role in roles]) * self.anatomy.scale
        return np.array(pairs), radii, np.array([_SIDES[r.side][1] if r.side in _SIDES else self.colour for r in roles])


def at_rest(skeleton: Skeleton = CANONICAL) -> Motion:
    """Return one frame of a skeleton in its rest pose, the lowest joint as high as a toe joint of a flat foot."""
    motion = Motion.at_rest(skeleton)
    lowest = float(motion.joint_positions()[..., 1].min())
    return replace(motion, root_position=torch.tensor([[0.0, TOE_REST_HEIGHT - lowest, 0.0]], dtype=torch.float64))
