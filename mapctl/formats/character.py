"""Characters in files (glTF, VRM, USD, FBX): rest frames, times of frames, meshes, and the file that a motion is of."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from fractions import Fraction
from os import PathLike
from pathlib import Path

import numpy as np
import torch

from mapctl import kinematics, rotations
from mapctl.errors import MapctlError, RequestError
from mapctl.formats import parts
from mapctl.formats.sandbox import Refusal
from mapctl.formats.text import check_ordinary, warn_once
from mapctl.formats.units import USUAL_FPS
from mapctl.mesh.character_mesh import CharacterMesh, compute_normals, merge_meshes
from mapctl.mesh.mannequin import build_skin
from mapctl.motion import Motion
from mapctl.skeleton import Skeleton

Array = np.ndarray
STILL_METRES = 1e-5
"""A joint whose offset varies by less stays still; files of 32-bit numbers round to 1e-7 of a body."""
NEW_NODE = -1
"""Placeholder for the node of a joint that is yet to be added to the file."""
_LARGEST = 1e12  # whatever the unit
_MAX_VERTICES = 2**23
_MOST_CARRIERS = 4  # joints of a vertex, as every engine takes them
_FAMILIES = {".gltf": ".glb", ".vrm": ".glb", ".usda": ".usd", ".usdc": ".usd", ".usdz": ".usd"}


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
    def of(names: Sequence[str], parents: tuple[int, ...], worlds: Array, outer: Array) -> "RestFrames":
        """Take them from world matrices (joints, 4, 4) at rest. UnevenScaleError names a joint that is stretched."""
        turns, scales = parts.split_scales(parents, worlds, names)
        parts.split_scale(outer)
        quats = rotations.from_matrix(torch.from_numpy(turns)).numpy()
        return RestFrames(tuple(names), parents, worlds[:, :3, 3].copy(), quats, scales, outer)

    @property
    def are_aligned(self) -> bool:
        """Whether the file's own joint frames are aligned with the world at rest."""
        return bool(np.allclose(np.abs(self.quat_xyzw[:, 3]), 1.0, atol=1e-6))

    def matrices(self) -> Array:
        """Return the joints' world matrices at rest, (joints, 4, 4)."""
        return parts.compose_matrices(self.positions, self.quat_xyzw, np.repeat(self.scales[:, None], 3, axis=1))

    def with_root(self, name: str) -> "RestFrames":
        """Return the same joints below a further one, which at rest is where the frame is that the root is in."""
        turn, scale = parts.split_scale(self.outer)
        quat = rotations.from_matrix(torch.from_numpy(turn)).numpy()
        return RestFrames(
            (name, *self.names),
            (-1, *(parent + 1 for parent in self.parents)),
            np.vstack([self.outer[:3, 3], self.positions]),
            np.vstack([quat, self.quat_xyzw]),
            np.concatenate([[scale], self.scales]),
            self.outer,
        )

    def skeleton(self, tips: Mapping[int, Array]) -> Skeleton:
        """Return the skeleton whose frames are aligned with the world; `tips` (3,) are End Sites at rest in the world,
        by joint, metres."""
        offsets = self.positions - self.positions[[max(parent, 0) for parent in self.parents]]
        ends = {self.names[joint]: tuple((tip - self.positions[joint]).tolist()) for joint, tip in tips.items()}
        return Skeleton(self.names, self.parents, torch.from_numpy(offsets), ends)

    def to_motion(self, worlds: Array, fps: Fraction, skeleton: Skeleton, source: object) -> Motion:
        """Return the motion of world matrices (frames, joints, 4, 4) in the file's joint frames."""
        turns = torch.from_numpy(parts.nearest_rotations(np.sign(self.scales)[:, None, None] * worlds[..., :3, :3]))
        rest = torch.from_numpy(self.quat_xyzw)
        world = rotations.multiply(rotations.from_matrix(turns), rotations.inverse(rest))
        positions = torch.from_numpy(worlds[..., :3, 3].copy())
        local = rotations.make_sign_continuous(kinematics.local_from_world(self.parents, world))
        moving = {}
        for joint, parent in enumerate(self.parents[1:], start=1):
            offset = rotations.rotate(rotations.inverse(world[:, parent]), positions[:, joint] - positions[:, parent])
            if float((offset - skeleton.offsets[joint]).abs().max()) > STILL_METRES:
                moving[joint] = offset
        return Motion(skeleton, fps, positions[:, 0], local, moving, source)

    def to_locals(self, motion: Motion) -> tuple[Array, Array]:
        """Return translations (frames, joints, 3) and rotations (frames, joints, 4), xyzw, in the file's frames: of
        each joint in its parent's, of the root in the frame that `outer` takes to the world."""
        frames = motion.num_frames
        world = rotations.multiply(motion.joint_rotations(), torch.from_numpy(self.quat_xyzw))
        turn, unit = parts.split_scale(self.outer)
        base = rotations.from_matrix(torch.from_numpy(turn)).expand(frames, 4)
        origin, positions = torch.from_numpy(self.outer[:3, 3].copy()), motion.joint_positions()
        moved, turned = torch.empty_like(positions), torch.empty_like(world)
        for joint, parent in enumerate(self.parents):
            above = base if parent < 0 else world[:, parent]
            start = origin if parent < 0 else positions[:, parent]
            back, scale = rotations.inverse(above), unit if parent < 0 else self.scales[parent]
            moved[:, joint] = rotations.rotate(back, positions[:, joint] - start) / scale
            turned[:, joint] = rotations.multiply(back, world[:, joint])
        return moved.numpy(), rotations.make_sign_continuous(turned).numpy()


@dataclass(frozen=True, eq=False)
class CharacterSource:
    """A character's file, and which of its armatures and animations a motion is of."""

    path: Path
    """The file; read again when the character is written or drawn."""
    armature: str
    frames: RestFrames
    nodes: tuple[int | str, ...]
    """By joint what the file calls it: the index of a node, the path of a prim; `NEW_NODE` for one that it lacks."""
    stamp: tuple[int, int]
    """Its size in bytes and time of change, by which a later change of it is noticed."""
    animation: str | None = None
    """Name of the animation that the motion was read from; None for the rest pose."""
    metres_per_unit: float = 1.0
    """Length of the unit that the file declares, metres."""
    humanoid: Mapping[str, str] = field(default_factory=dict)
    """Joint name by canonical name, where the file itself maps them (VRM)."""
    armatures: Sequence[str] = ()
    """Names of all armatures in the file."""
    animations: Mapping[str, float] = field(default_factory=dict)
    """Seconds by name of the file's animations of this armature; empty where its rest pose was requested."""

    @staticmethod
    def of(chosen: parts.CharacterPath, found: parts.FoundCharacter, frames: RestFrames) -> "CharacterSource":
        """Return the source of a motion of what was found in a file; log which animation was read where there are
        others and the path chooses none."""
        others = [name for name in found.animations if name != found.animation]
        if chosen.animation is None and others:
            what = "its rest pose, none" if found.animation is None else f"{found.animation!r}, the first"
            another = f"{chosen.file.name}#{chosen.armature or ''}/{others[0]}"
            names = len(found.animations)
            warn_once(f"{chosen.file}: reads {what} of {names} animations; choose another as {another!r}")
        same = ("armature", "animation", "metres_per_unit", "humanoid", "armatures", "animations")
        kept, file = {name: getattr(found, name) for name in same}, chosen.file
        return CharacterSource(file.resolve(), frames=frames, nodes=(*found.nodes,), stamp=_stamp_file(file), **kept)

    @property
    def has_new_root(self) -> bool:
        """Whether joint 0 is none of the file's, but above them."""
        return self.nodes[0] == NEW_NODE

    def holds(self, motion: Motion) -> bool:
        """Return whether the motion's skeleton still has this character's joints."""
        skeleton = motion.skeleton
        return (skeleton.names, skeleton.parents) == (self.frames.names, self.frames.parents)

    def check_unchanged(self) -> None:
        """Raise RequestError unless the file is as it was when it was read."""
        if not self.path.is_file() or _stamp_file(self.path) != self.stamp:
            raise RequestError(f"{self.path} has changed since it was read; the character cannot be taken from it")


def _stamp_file(path: Path) -> tuple[int, int]:
    status = path.stat()
    return status.st_size, status.st_mtime_ns


def add_root_to_character(source: object | None, name: str) -> CharacterSource | None:
    """Return a character with a joint above its root, where its file is of a kind that can get one: glTF and VRM."""
    if not isinstance(source, CharacterSource) or _family(source.path.suffix) != ".glb" or source.has_new_root:
        return None
    return replace(source, frames=source.frames.with_root(name), nodes=(NEW_NODE, *source.nodes))


def character_of(motion: Motion, ending: str) -> CharacterSource | None:
    """Return the character that a motion is of, if its file has this ending and its joints are the motion's.
    RequestError where the file has changed since it was read."""
    source = motion.source
    if not isinstance(source, CharacterSource) or not source.holds(motion):
        return None
    if _family(source.path.suffix) != _family(ending):
        return None
    source.check_unchanged()
    return source


def _family(ending: str) -> str:
    """Return one ending for all of a format."""
    return _FAMILIES.get(ending.lower(), ending.lower())


Reader = Callable[..., parts.FoundCharacter]
"""Reads what is chosen of a file by `armature` and `animation`, and of it what is `wanted`: motion, rest or mesh."""


def load_motion(path: str | PathLike[str], read: Reader) -> Motion:
    """Read an animation; one frame of the rest pose where there is none.

    `path` may end as `#ARMATURE`, `#ARMATURE/ANIMATION` or `#/ANIMATION`; by default the file's first animation that
    moves the armature is read, and a file of several armatures is refused, naming them. Joint frames are aligned with
    the world in the rest pose. FileFormatError names the fault of the file.
    """
    with parts.names_file(path):
        found, frames, skeleton, source = _read(path, read, "motion")
        fps, worlds = found.motion or (USUAL_FPS, frames.matrices()[None])
        return replace(frames.to_motion(worlds, fps, skeleton, source), licence=found.licence)


def load_rest(path: str | PathLike[str], read: Reader) -> Motion:
    """Read one frame of the rest pose, as `load_motion` reads an animation."""
    with parts.names_file(path):
        _, frames, skeleton, source = _read(path, read, "rest")
        return frames.to_motion(frames.matrices()[None], USUAL_FPS, skeleton, source)


def load_mesh(path: str | PathLike[str], read: Reader) -> CharacterMesh:
    """Read the triangles in the rest pose: what the armature's skins carry, and what hangs on its joints rigidly.
    `path` chooses as in `load_motion`. FileFormatError where the armature has none, or they are broken."""
    with parts.names_file(path):
        found, frames, _, _ = _read(path, read, "mesh")
        meshes = [_build_part(part, frames) for part in found.parts if len(part.faces)]
        if not meshes:
            raise Refusal(f"armature {found.armature!r} carries no triangles")
        return merge_meshes(meshes)


def _read(
    path: str | PathLike[str], read: Reader, wanted: str
) -> tuple[parts.FoundCharacter, RestFrames, Skeleton, CharacterSource]:
    chosen = parts.parse_character_path(path)
    check_ordinary(chosen.file)
    found = read(chosen.file, armature=chosen.armature, animation=chosen.animation, wanted=wanted)
    if found.fault:
        warn_once(f"{chosen.file}: {found.fault}; its joints and motion are read")
    frames = RestFrames.of(found.names, found.parents, found.worlds, found.outer)
    rests = frames.matrices()
    tips = {joint: (rests[joint] @ end)[:3, -1] for joint, end in found.ends.items()}
    return found, frames, frames.skeleton(tips), CharacterSource.of(chosen, found, frames)


def _build_part(part: parts.MeshPart, frames: RestFrames) -> CharacterMesh:
    count = len(part.points)
    if count > _MAX_VERTICES:
        raise Refusal(f"a mesh has {count} vertices, allowed are {_MAX_VERTICES}")
    for table in (part.points, part.matrices, part.rgba):
        if not np.isfinite(table).all() or np.abs(table).max(initial=0.0) > _LARGEST:
            raise Refusal("its mesh holds numbers that are not finite, or too large")
    for table, most, what in ((part.faces, count, "vertex"), (part.rows, len(part.joints), "joint")):
        if table.min(initial=0) < 0 or table.max(initial=0) >= most:
            raise Refusal(f"its mesh names {what} {table.max()} of {most}")
    matrices = frames.matrices()[part.joints] @ part.matrices
    vertices = np.zeros((count, 3))
    for row, share in zip(part.rows.T, part.shares.T, strict=True):
        moved = np.einsum("nab,nb->na", matrices[row][:, :3, :3], part.points) + matrices[row][:, :3, 3]
        vertices += share[:, None] * moved
    if not np.isfinite(vertices).all() or np.abs(vertices).max() > parts.FARTHEST:
        raise Refusal("its mesh holds numbers that are not finite, or larger than 1000 km")
    normals = compute_normals(vertices, part.faces)
    joints = part.joints[part.rows]
    return CharacterMesh(vertices, normals, part.faces, part.rgba, joints, part.shares, frames.positions)


def build_skinned_body(motion: Motion) -> tuple[str, CharacterMesh]:
    """Build the body of a motion, with the root at the origin: the mesh of the character that it is of, with a colour
    at every vertex and at most four joints that carry it, where that came from a file of another format; else the
    mannequin. Return its name, too."""
    mesh = _load_own_mesh(motion)
    if mesh is None:
        return "mannequin", build_skin(motion)
    order = np.argsort(-mesh.weights, axis=1, kind="stable")[:, :_MOST_CARRIERS]
    joints, weights = (np.take_along_axis(table, order, axis=1) for table in (mesh.joints, mesh.weights))
    weights /= weights.sum(axis=1, keepdims=True)
    vertices, rest = mesh.vertices - mesh.rest[0], Motion.at_rest(motion.skeleton).joint_positions()[0].numpy()
    return "character", replace(mesh, vertices=vertices, joints=joints, weights=weights, rest=rest)


def _load_own_mesh(motion: Motion) -> CharacterMesh | None:
    """Load the mesh of the character's file; None for other motions, and for files without triangles."""
    source = motion.source
    if not isinstance(source, CharacterSource) or not source.holds(motion) or source.has_new_root:
        return None
    from mapctl.formats import load_mesh

    try:
        source.check_unchanged()
        return load_mesh(f"{source.path}#{source.armature}")
    except MapctlError:
        return None
