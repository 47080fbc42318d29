"""Characters in files (glTF, VRM, USD, FBX): which of a file is meant, its rest frames, key times and meshes."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from fractions import Fraction
from importlib import import_module
from importlib.util import find_spec
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
import torch

from mapctl import kinematics, rotations
from mapctl.errors import FileFormatError, MapctlError, RequestError
from mapctl.formats import sandbox
from mapctl.formats.parts import CharacterPath, FoundCharacter, MeshPart, decode_srgb, find_name, parse_character_path
from mapctl.formats.sandbox import Refusal
from mapctl.formats.text import check_ordinary, warn_once
from mapctl.formats.units import FASTEST, frame_rate
from mapctl.mesh.character_mesh import CharacterMesh, compute_normals, merge_meshes
from mapctl.mesh.mannequin import build_skin
from mapctl.motion import Motion
from mapctl.skeleton import Skeleton

Array = np.ndarray
STILL_METRES = 1e-5
"""A joint whose offset varies by less stays still; files of 32-bit numbers round to 1e-7 of a body."""
_BONE_SHARE = 0.02  # of a bone's length by which it may differ between bind pose and nodes
_DEFAULT_FPS = Fraction(30)
_UNEVEN_SHARE = 0.02  # of a frame that a key may lie beside it
NEW_NODE = -1
"""What stands for the node of a joint that the file is yet to get."""
_FARTHEST = 1e6
_LARGEST = 1e12  # whatever the unit
_MAX_VERTICES = 2**23


def choose_name(path: Path, names: Sequence[str], wanted: str | None, what: str, *, several: bool) -> int:
    """Return the index of the wanted name, or of the only or first one; `what` is `armature` or `animation`.

    FileFormatError lists the names where none is the wanted one, or several are there and one must be chosen.
    """
    try:
        return find_name(path.name, names, wanted, what, several=several)
    except Refusal as refusal:
        raise FileFormatError(path, refusal.args[0]) from None


def read_native(
    path: str | PathLike[str], wanted: str, *, reader: str, package: str, needed: str
) -> tuple[CharacterPath, Any]:
    """Return what a path chooses, and what the native reader of that module of this package finds of it: `wanted` is
    `rest`, `motion` or `mesh`. FileFormatError says what is `needed` where the reader's package is not installed."""
    chosen = parse_character_path(path)
    if find_spec(package) is None:
        raise FileFormatError(chosen.file, needed)
    check_ordinary(chosen.file)
    options = {"armature": chosen.armature, "animation": chosen.animation, "wanted": wanted}
    return chosen, sandbox.call(import_module(f"mapctl.formats.{reader}").read_character, chosen.file, **options)


def note_animation(chosen: CharacterPath, names: Collection[str], read: str | None) -> None:
    """Log which of an armature's animations was read, where there are others and the path chooses none."""
    others = [name for name in names if name != read]
    if chosen.animation is None and others:
        what = "its rest pose, none" if read is None else f"{read!r}, the first"
        another = f"{chosen.file.name}#{chosen.armature or ''}/{others[0]}"
        warn_once(f"{chosen.file}: reads {what} of {len(names)} animations; choose another as {another!r}")


class UnevenScaleError(ValueError):
    """A matrix stretches by different factors along its axes, mirrors, or shears; `args[0]` says which, `joint` of
    which joint, where it is one of several."""

    joint: int = 0


@dataclass(frozen=True, eq=False)
class RestFrames:
    """A character's joints as its file has them at rest, in a world with Y up and in metres.

    A file turns a joint in a frame that its modeller chose; a `Motion` that comes from it turns it about the world's
    axes, so that all rotations zero are the rest pose, whatever the file's frames are. With R_j a joint's world
    rotation at rest and G_j that of a frame: rotation of the motion in the world = G_j * inverse(R_j).
    """

    names: tuple[str, ...]
    """Joint names, unique, joint 0 the root."""
    parents: tuple[int, ...]
    """Index of each joint's parent, -1 for the root."""
    positions: Array
    """(joints, 3) at rest, metres."""
    quat_xyzw: Array
    """(joints, 4) world rotations at rest."""
    scales: Array
    """(joints,) metres of the world by unit of the joint's frame; negative for a last joint that mirrors."""
    outer: Array
    """(4, 4) what takes the frame that the root is in to the world: placement, up axis and unit of the file."""

    @staticmethod
    def of(names: tuple[str, ...], parents: tuple[int, ...], worlds: Array, outer: Array) -> "RestFrames":
        """Take them from world matrices (joints, 4, 4) at rest. UnevenScaleError names a joint that is stretched."""
        try:
            turns, scales = split_scales(parents, worlds)
        except UnevenScaleError as error:
            raise UnevenScaleError(f"joint {names[error.joint]}: {error}") from None
        split_scale(outer)
        quats = rotations.from_matrix(torch.from_numpy(turns)).numpy()
        return RestFrames(names, parents, worlds[:, :3, 3].copy(), quats, scales, outer)

    @property
    def are_aligned(self) -> bool:
        """Whether the file's own joint frames are aligned with the world at rest."""
        return bool(np.allclose(np.abs(self.quat_xyzw[:, 3]), 1.0, atol=1e-6))

    def matrices(self) -> Array:
        """Return the joints' world matrices at rest, (joints, 4, 4)."""
        return compose_matrices(self.positions, self.quat_xyzw, np.repeat(self.scales[:, None], 3, axis=1))

    def with_root(self, name: str) -> "RestFrames":
        """Return the same joints below a further one, which at rest is where the frame is that the root is in."""
        turn, scale = split_scale(self.outer)
        quat = rotations.from_matrix(torch.from_numpy(turn)).numpy()
        return RestFrames(
            (name, *self.names),
            (-1, *(parent + 1 for parent in self.parents)),
            np.vstack([self.outer[:3, 3], self.positions]),
            np.vstack([quat, self.quat_xyzw]),
            np.concatenate([[scale], self.scales]),
            self.outer,
        )

    def skeleton(self, end_positions: Mapping[int, Array]) -> Skeleton:
        """Return the skeleton whose frames are aligned with the world; `end_positions` are those of End Sites at rest,
        by joint, metres."""
        offsets = self.positions - self.positions[[max(parent, 0) for parent in self.parents]]
        ends = {self.names[j]: tuple((end - self.positions[j]).tolist()) for j, end in end_positions.items()}
        return Skeleton(self.names, self.parents, torch.from_numpy(offsets), ends)

    def rest_motion(self, skeleton: Skeleton, source: object) -> Motion:
        """Return one frame of the rest pose."""
        return self.to_motion(self.matrices()[None], _DEFAULT_FPS, skeleton, source)

    def to_motion(self, worlds: Array, fps: Fraction, skeleton: Skeleton, source: object) -> Motion:
        """Return the motion of world matrices (frames, joints, 4, 4) in the file's joint frames."""
        turns = torch.from_numpy(nearest_rotations(np.sign(self.scales)[:, None, None] * worlds[..., :3, :3]))
        world = rotations.multiply(
            rotations.from_matrix(turns),
            rotations.inverse(torch.from_numpy(self.quat_xyzw)).expand(*worlds.shape[:2], 4),
        )
        places = torch.from_numpy(worlds[..., :3, 3].copy())
        local = rotations.make_sign_continuous(kinematics.local_from_world(self.parents, world))
        moving = {}
        for joint, parent in enumerate(self.parents[1:], start=1):
            offset = rotations.rotate(rotations.inverse(world[:, parent]), places[:, joint] - places[:, parent])
            if float((offset - skeleton.offsets[joint]).abs().max()) > STILL_METRES:
                moving[joint] = offset
        return Motion(skeleton, fps, places[:, 0], local, moving, source)

    def to_locals(self, motion: Motion) -> tuple[Array, Array]:
        """Return translations (frames, joints, 3) and rotations (frames, joints, 4), xyzw, in the file's frames: of
        each joint in its parent's, of the root in the frame that `outer` takes to the world."""
        frames = motion.num_frames
        rest = torch.from_numpy(self.quat_xyzw).expand(frames, -1, -1)
        world = rotations.multiply(motion.joint_rotations(), rest)
        turn, unit = split_scale(self.outer)
        base = rotations.from_matrix(torch.from_numpy(turn)).expand(frames, 4)
        origin, places = torch.from_numpy(self.outer[:3, 3].copy()), motion.joint_positions()
        moved, turned = torch.empty_like(places), torch.empty_like(world)
        for joint, parent in enumerate(self.parents):
            above = base if parent < 0 else world[:, parent]
            start = origin.expand(frames, 3) if parent < 0 else places[:, parent]
            back, scale = rotations.inverse(above), unit if parent < 0 else self.scales[parent]
            moved[:, joint] = rotations.rotate(back, places[:, joint] - start) / scale
            turned[:, joint] = rotations.multiply(back, world[:, joint])
        return moved.numpy(), rotations.make_sign_continuous(turned).numpy()


def build_frames(
    path: Path, armature: str, names: Sequence[str], parents: tuple[int, ...], worlds: Array, outer: Array
) -> RestFrames:
    """Return `RestFrames.of` an armature's joints; FileFormatError names one that is stretched."""
    try:
        return RestFrames.of(tuple(names), parents, worlds, outer)
    except UnevenScaleError as error:
        what = f"armature {armature!r}: {error.args[0]}; apply it and export again"
        raise FileFormatError(path, what) from None


def split_scales(parents: tuple[int, ...], worlds: Array) -> tuple[Array, Array]:
    """Return rotations (joints, 3, 3) and scales (joints,) of world matrices (joints, 4, 4).

    UnevenScaleError as of `split_scale`; but last joints, in whose frames no other is, may mirror.
    """
    turns, scales = np.empty((len(parents), 3, 3)), np.empty(len(parents))
    for joint, matrix in enumerate(worlds):
        try:
            turns[joint], scales[joint] = split_scale(matrix, may_mirror=joint not in parents)
        except UnevenScaleError as error:
            error.joint = joint
            raise
    return turns, scales


def split_scale(matrix: Array, *, may_mirror: bool = False) -> tuple[Array, float]:
    """Return rotation (3, 3) and scale of a (4, 4) matrix that turns and scales alike along all axes.

    UnevenScaleError where it does not: where it stretches, mirrors or shears by more than a thousandth. One that
    `may_mirror` has a negative scale where it does.
    """
    linear, sign = matrix[:3, :3], 1.0
    if may_mirror and np.linalg.det(linear) < 0:
        linear, sign = -linear, -1.0
    lengths = np.linalg.norm(linear, axis=0)
    scale = float(np.cbrt(abs(np.linalg.det(linear))))
    if not scale > 1e-9:
        raise UnevenScaleError("its scale is zero")
    if np.linalg.det(linear) < 0:
        raise UnevenScaleError("its scale is negative, which mirrors")
    if not np.allclose(lengths, scale, rtol=1e-3) or not np.allclose(
        linear.T @ linear, scale**2 * np.eye(3), atol=2e-3 * scale**2
    ):
        raise UnevenScaleError(f"its scale is not the same along all axes ({', '.join(f'{x:.4g}' for x in lengths)})")
    return nearest_rotations(linear), sign * scale


def nearest_rotations(linear: Array) -> Array:
    """Return the rotations (..., 3, 3) nearest to matrices (..., 3, 3), by singular values."""
    left, _, right = np.linalg.svd(linear)
    flip = np.ones(linear.shape[:-1])
    flip[..., -1] = np.linalg.det(left @ right)
    return (left * flip[..., None, :]) @ right


def compose_matrices(translations: Array, quat_xyzw: Array, scales: Array) -> Array:
    """Return matrices (..., 4, 4) that scale by (..., 3), then turn by (..., 4), then move by (..., 3)."""
    turns = rotations.to_matrix(torch.from_numpy(np.ascontiguousarray(quat_xyzw))).numpy()
    matrices = np.zeros((*turns.shape[:-2], 4, 4))
    matrices[..., :3, :3] = turns * scales[..., None, :]
    matrices[..., :3, 3] = translations
    matrices[..., 3, 3] = 1.0
    return matrices


def chain_matrices(parents: tuple[int, ...], local: Array, outer: Array) -> Array:
    """Return world matrices (..., joints, 4, 4) of local ones; `outer` (4, 4) takes the root's frame to the world."""
    worlds = np.empty_like(local)
    for joint, parent in enumerate(parents):
        worlds[..., joint, :, :] = (outer if parent < 0 else worlds[..., parent, :, :]) @ local[..., joint, :, :]
    return worlds


def complete_bind_pose(parents: tuple[int, ...], bound: Mapping[int, Array], worlds: Array) -> Array | None:
    """Complete the world matrices (4, 4) of a bind pose, by joint, with those of the nodes, (joints, 4, 4), for joints
    that it leaves out; None unless all bones are as long as the nodes', and joints are scaled like them."""
    done = np.empty_like(worlds)
    for joint, parent in enumerate(parents):
        above = np.eye(4) if parent < 0 else done[parent]
        own = worlds[joint] if parent < 0 else np.linalg.pinv(worlds[parent]) @ worlds[joint]
        done[joint] = bound.get(joint, above @ own)
        if parent >= 0:
            length, usual = (np.linalg.norm(w[joint][:3, 3] - w[parent][:3, 3]) for w in (done, worlds))
            if abs(length - usual) > _BONE_SHARE * max(usual, 0.02):
                return None
    try:
        scales = split_scales(parents, done)[1] / split_scales(parents, worlds)[1]
    except UnevenScaleError:
        return None
    return done if np.allclose(scales, 1.0, rtol=1e-2) else None


def sample_times(keys: np.ndarray) -> tuple[Fraction, np.ndarray]:
    """Return frames per second and the times, seconds, at which to read an animation with keys at these times.

    Keys that lie on the frames of one rate (not on all of them need one lie) give that rate; others are read at 30
    frames a second, the last key at or before the last frame.
    """
    keys = np.unique(np.asarray(keys, np.float64))
    if len(keys) < 2:
        return _DEFAULT_FPS, keys[:1] if len(keys) else np.zeros(1)
    span = keys[-1] - keys[0]
    fps = _find_rate(keys - keys[0])
    count = int(np.floor(span * float(fps) + _UNEVEN_SHARE)) + 1
    return fps, keys[0] + np.arange(count) / float(fps)


def _find_rate(keys: np.ndarray) -> Fraction:
    """Return the rate of which every key, from 0 on, is a frame; 30 where there is none."""
    apart = np.diff(keys)
    step = float(np.median(apart[apart > 0.25 * np.median(apart)]))
    candidates = [step, *(step / part for part in (2, 3, 4, 5)), 1 / 30, 1 / 24, 1 / 25, 1 / 60, 1 / 120]
    for seconds in candidates:
        if not 1 / FASTEST < seconds < 100:
            continue
        seconds = keys[-1] / max(1, round(keys[-1] / seconds))  # keys are rounded one by one, their whole span hardly
        fps = frame_rate(f"{seconds:.7f}") if seconds > 1e-4 else Fraction(1 / seconds)
        frames = keys * float(fps)
        if np.abs(frames - np.rint(frames)).max() < _UNEVEN_SHARE:
            return fps
    return _DEFAULT_FPS


@dataclass(frozen=True, eq=False)
class CharacterSource:
    """A character's file, and which of its armatures and animations a motion is of."""

    path: Path
    """The file; read again when the character is written or drawn."""
    armature: str
    """Name of the armature in it."""
    stamp: tuple[int, int]
    """Its size in bytes and time of change, by which a later change of it is noticed."""
    frames: RestFrames
    """Its joints at rest."""
    nodes: tuple[int | str, ...]
    """By joint what the file calls it: the index of a node, the path of a prim; `NEW_NODE` for one that it lacks."""
    animation: str | None = None
    """Name of the animation that the motion was read from; None for the rest pose."""
    metres_per_unit: float = field(default=1.0, kw_only=True)
    """Length of the unit that the file declares, metres."""
    humanoid: Mapping[str, str] = field(default_factory=dict)
    """Joint name by canonical name, where the file itself says which is which (VRM)."""
    armatures: Sequence[str] = ()
    """Names of all armatures in the file."""
    animations: Mapping[str, float] = field(default_factory=dict)
    """Seconds by name of the file's animations of this armature; empty where its rest pose was asked for."""

    @property
    def has_new_root(self) -> bool:
        """Whether joint 0 is none of the file's, but above them."""
        return self.nodes[0] == NEW_NODE

    @property
    def choice(self) -> str:
        """The path that chooses this armature."""
        return f"{self.path}#{self.armature}"

    def holds(self, motion: Motion) -> bool:
        """Return whether the motion's skeleton still has this character's joints."""
        skeleton = motion.skeleton
        return (skeleton.names, skeleton.parents) == (self.frames.names, self.frames.parents)

    def check_unchanged(self) -> None:
        """Raise RequestError unless the file is as it was when it was read."""
        if not self.path.is_file() or stamp_file(self.path) != self.stamp:
            raise RequestError(f"{self.path} has changed since it was read; the character cannot be taken from it")


def describe_source(
    chosen: CharacterPath, found: FoundCharacter, frames: RestFrames, nodes: tuple[int | str, ...]
) -> CharacterSource:
    """Return the source of a motion of what was found in a file."""
    return CharacterSource(
        chosen.file.resolve(),
        found.armature,
        stamp_file(chosen.file),
        frames,
        nodes,
        found.animation,
        armatures=found.armatures,
        animations=found.animations,
        metres_per_unit=found.metres_per_unit,
    )


def add_root_to_character(source: object | None, name: str) -> CharacterSource | None:
    """Return a character with a joint above its root, where its file is of a kind that can get one: glTF and VRM."""
    if not isinstance(source, CharacterSource) or ending_family(source.path.suffix) != ".glb" or source.has_new_root:
        return None
    return replace(source, frames=source.frames.with_root(name), nodes=(NEW_NODE, *source.nodes))


def stamp_file(path: str | PathLike[str]) -> tuple[int, int]:
    """Return size in bytes and time of change, nanoseconds."""
    status = Path(path).stat()
    return status.st_size, status.st_mtime_ns


def character_of(motion: Motion, ending: str) -> CharacterSource | None:
    """Return the character that a motion is of, if its file has this ending and its joints are the motion's."""
    source = motion.source
    if not isinstance(source, CharacterSource) or not source.holds(motion):
        return None
    return source if ending_family(source.path.suffix) == ending_family(ending) else None


def ending_family(ending: str) -> str:
    """Return one ending for all of a format: .glb for .gltf and .vrm, .usd for .usda, .usdc and .usdz."""
    plain = ending.lower()
    families = {".gltf": ".glb", ".vrm": ".glb", ".usda": ".usd", ".usdc": ".usd", ".usdz": ".usd"}
    return families.get(plain, plain)


def compose_transforms(path: str | PathLike[str], transforms: Array) -> Array:
    """Return matrices (..., 4, 4) of translation, rotation xyzw and scale (..., 10). FileFormatError where they are not
    finite, or larger than 1000 km."""
    if not np.isfinite(transforms).all() or np.abs(transforms).max(initial=0.0) > _FARTHEST:
        raise FileFormatError(path, "its animation holds numbers that are not finite, or larger than 1000 km")
    turns = transforms[..., 3:7]
    lengths = np.linalg.norm(turns, axis=-1, keepdims=True)
    if lengths.min(initial=1.0) < 1e-6:
        raise FileFormatError(path, "its animation holds a rotation of length zero")
    return compose_matrices(transforms[..., :3], turns / lengths, transforms[..., 7:])


def check_size(path: str | PathLike[str], worlds: Array) -> None:
    """Raise FileFormatError unless matrices (..., 4, 4) are finite and within 1000 km."""
    if not np.isfinite(worlds).all() or np.abs(worlds).max(initial=0.0) > _FARTHEST:
        raise FileFormatError(path, "its joints are at places that are not finite, or larger than 1000 km")


def place_joints(path: str | PathLike[str], parents: tuple[int, ...], local: Array, outer: Array) -> Array:
    """Return world matrices (..., joints, 4, 4) of local ones, as `chain_matrices`. FileFormatError where they are not
    finite, or larger than 1000 km."""
    with np.errstate(all="ignore"):
        worlds = chain_matrices(parents, local, outer)
    check_size(path, worlds)
    return worlds


def frame_rate_of(rate: float) -> Fraction:
    """Return the exact frame rate behind one that a file says as a floating-point number: 29.97 is 30000/1001."""
    near = frame_rate(f"{1.0 / rate:.6f}") if 0.01 < rate < 1e4 else Fraction(rate)
    return near if abs(float(near) / rate - 1.0) < 1e-5 else Fraction(rate).limit_denominator(10_000)


def build_mesh(
    path: str | PathLike[str], armature: str, parts: Sequence[MeshPart], frames: RestFrames
) -> CharacterMesh:
    """Build the mesh of all parts in the rest pose. FileFormatError where there is none, or it is broken."""
    found = [build_part(path, part, frames) for part in parts if len(part.faces)]
    if not found:
        raise FileFormatError(path, f"armature {armature!r} carries no triangles")
    return merge_meshes(found)


def build_part(path: str | PathLike[str], part: MeshPart, frames: RestFrames) -> CharacterMesh:
    """Build the mesh of one part in the rest pose. FileFormatError where it is broken."""
    count = len(part.points)
    if count > _MAX_VERTICES:
        raise FileFormatError(path, f"a mesh has {count} vertices, allowed are {_MAX_VERTICES}")
    for table in (part.points, part.matrices, part.rgba):
        if not np.isfinite(table).all() or np.abs(table).max(initial=0.0) > _LARGEST:
            raise FileFormatError(path, "its mesh holds numbers that are not finite, or too large")
    if part.faces.min(initial=0) < 0 or part.faces.max(initial=0) >= count:
        raise FileFormatError(path, f"a triangle names vertex {part.faces.max()} of {count}")
    if part.rows.min() < 0 or part.rows.max() >= len(part.joints):
        raise FileFormatError(path, f"a vertex names joint {part.rows.max()} of {len(part.joints)}")
    matrices = frames.matrices()[part.joints] @ part.matrices
    vertices = np.zeros((count, 3))
    for row, share in zip(part.rows.T, part.shares.T, strict=True):
        moved = np.einsum("nab,nb->na", matrices[row][:, :3, :3], part.points) + matrices[row][:, :3, 3]
        vertices += share[:, None] * moved
    if not np.isfinite(vertices).all() or np.abs(vertices).max() > _FARTHEST:
        raise FileFormatError(path, "its mesh holds numbers that are not finite, or larger than 1000 km")
    normals = compute_normals(vertices, part.faces)
    rest = frames.positions
    return CharacterMesh(vertices, normals, part.faces, part.rgba, part.joints[part.rows], part.shares, rest)


_MOST_CARRIERS = 4  # joints of a vertex, as every engine takes them


@dataclass(frozen=True, eq=False)
class SkinnedBody:
    """A body in its skeleton's rest pose: no joint is turned and the root is at the origin."""

    name: str
    """What it is: the mannequin, or a character's own mesh."""
    rest: Array
    """(joints, 3) joints, metres."""
    vertices: Array
    """(n, 3) metres."""
    normals: Array
    """(n, 3) unit."""
    faces: Array
    """(m, 3) vertex indices, counter-clockwise seen from outside."""
    linear_rgb: Array
    """(n, 3) colours, 0 to 1, in proportion to light as both formats want them."""
    joints: Array
    """(n, k) indices of the joints that move a vertex, at most four."""
    weights: Array
    """(n, k) their shares; each vertex's add up to 1."""


def build_skinned_body(motion: Motion) -> SkinnedBody:
    """Build the body of a motion: the mesh of the character that it is of, with a colour at every vertex, where that
    came from a file of another format; else the mannequin."""
    rest, mesh = _rest_positions(motion), _load_own_mesh(motion)
    if mesh is not None:
        joints, weights = _strongest(mesh)
        vertices, rgb = mesh.vertices - mesh.rest[0], mesh.rgba[:, :3]
        return SkinnedBody("character", rest, vertices, mesh.normals, mesh.faces, decode_srgb(rgb), joints, weights)
    body = build_skin(motion)
    one = np.ones((len(body.joint), 1))
    vertices = body.vertices + rest[body.joint]
    return SkinnedBody(
        "mannequin", rest, vertices, body.normals, body.faces, decode_srgb(body.rgb), body.joint[:, None], one
    )


def _load_own_mesh(motion: Motion) -> CharacterMesh | None:
    """Load the mesh of the character's file; None for other motions, and for files without triangles."""
    source = motion.source
    if not isinstance(source, CharacterSource) or not source.holds(motion) or source.has_new_root:
        return None
    from mapctl.formats import load_mesh

    try:
        source.check_unchanged()
        return load_mesh(source.choice)
    except MapctlError:
        return None


def _strongest(mesh: CharacterMesh) -> tuple[Array, Array]:
    """Return the strongest carriers of each vertex, and their shares, which add up to 1."""
    order = np.argsort(-mesh.weights, axis=1, kind="stable")[:, :_MOST_CARRIERS]
    joints, weights = (np.take_along_axis(table, order, axis=1) for table in (mesh.joints, mesh.weights))
    return joints, weights / weights.sum(axis=1, keepdims=True)


def _rest_positions(motion: Motion) -> Array:
    """Return joint positions (joints, 3), metres, with all rotations zero and the root at the origin."""
    offsets, rest = motion.skeleton.offsets.numpy(), np.zeros((motion.num_joints, 3))
    for joint, parent in enumerate(motion.skeleton.parents):
        rest[joint] = offsets[joint] + rest[parent] if parent >= 0 else 0.0
    return rest
