"""USD in: a skeleton of UsdSkel, its rest pose, and the animation that is bound to it."""

from fractions import Fraction
from os import PathLike

import numpy as np
import torch

from mapctl import rotations
from mapctl.errors import FileFormatError
from mapctl.formats.characters.bind_pose import complete_bind_pose
from mapctl.formats.characters.extracted import build_mesh, check_size, compose_transforms, frame_rate_of, place_joints
from mapctl.formats.characters.key_times import sample_times
from mapctl.formats.characters.names import make_unique
from mapctl.formats.characters.rest_frames import RestFrames, UnevenScaleError, split_scale, split_scales
from mapctl.formats.characters.selector import CharacterPath, note_animation, parse_character_path
from mapctl.formats.characters.source import CharacterSource, stamp_file
from mapctl.formats.text import MAX_FILE_BYTES, MAX_POSES, check_extent, check_ordinary
from mapctl.formats.usd.installed import is_installed
from mapctl.isolated.parts import MeshPart, unpack_parts
from mapctl.isolated.process import Answer, ask
from mapctl.mesh.character_mesh import CharacterMesh
from mapctl.motion import Motion

Array = np.ndarray
_REST_FPS = Fraction(30)
_FASTEST_CODES = 240
"""Time codes per second up to which each is a frame; more are parts of frames."""


def load(path: str | PathLike[str]) -> Motion:
    """Read the animation of a skeleton from a .usd, .usda, .usdc or .usdz file; one frame of the rest pose where none
    is bound to it.

    `path` may end as `#SKELETON`, `#SKELETON/ANIMATION` or `#/ANIMATION`; a file of several skeletons is refused,
    naming them. Joint frames are aligned with the world in the rest pose. FileFormatError says what is wrong with the
    file.
    """
    chosen, found = _ask(path, "motion")
    frames = _read_frames(chosen, found)
    note_animation(chosen, found.said["animations"], found.said.get("animation"))
    if "local" not in found.arrays:
        return _rest_motion(chosen, found, frames)
    seconds, local, outers = (found.arrays[name] for name in ("seconds", "local", "outers"))
    fps, times = _choose_times(chosen, seconds, found.said["per_second"], len(frames.names))
    check_size(chosen.file, outers)
    local = compose_transforms(chosen.file, interpolate(seconds, local, times))
    if len(outers) > 1:
        outers = compose_transforms(chosen.file, interpolate(seconds, _split(chosen, outers), times))[:, 0]
    if len(frames.names) > local.shape[1]:
        local = np.concatenate([np.tile(np.eye(4), (len(times), 1, 1, 1)), local], axis=1)
    worlds = place_joints(chosen.file, frames.parents, local, outers)
    source = _source(chosen, found, frames)
    return frames.to_motion(worlds, fps, frames.skeleton({}), source)


def load_rest(path: str | PathLike[str]) -> Motion:
    """Read one frame of the rest pose, as `load` reads an animation."""
    chosen, found = _ask(path, "rest")
    return _rest_motion(chosen, found, _read_frames(chosen, found))


def load_mesh(path: str | PathLike[str]) -> CharacterMesh:
    """Read the meshes that are bound to a skeleton. `path` chooses as in `load`. FileFormatError where there is none,
    or they are broken."""
    chosen, found = _ask(path, "mesh")
    frames = _read_frames(chosen, found)
    added = len(frames.names) - len(found.said["names"])
    parts = [
        MeshPart(p.points, p.faces, p.rgba, p.joints + added, p.matrices, p.rows, p.shares)
        for p in unpack_parts(found.arrays, found.said["parts"])
    ]
    return build_mesh(chosen.file, found.said["armature"], parts, frames)


def interpolate(keys: Array, values: Array, times: Array) -> Array:
    """Return transforms (times, joints, 10) of those at keys (keys, joints, 10): linear, rotations along their arcs."""
    if len(keys) == len(times) and np.allclose(keys, times, atol=1e-9):
        return values
    after = np.searchsorted(keys, times, side="right").clip(1, len(keys) - 1) if len(keys) > 1 else np.zeros(1, int)
    before = np.maximum(after - 1, 0)
    gap = keys[after] - keys[before]
    share = np.where(gap > 0, (times - keys[before]) / np.where(gap > 0, gap, 1.0), 0.0).clip(0.0, 1.0)
    low, high = values[before], values[after]
    done = low + (high - low) * share[:, None, None]
    turns = [torch.from_numpy(np.ascontiguousarray(table[..., 3:7])).reshape(-1, 4) for table in (low, high)]
    shares = torch.from_numpy(np.repeat(share, values.shape[1]))
    units = [turn / turn.norm(dim=-1, keepdim=True).clamp_min(1e-12) for turn in turns]
    done[..., 3:7] = rotations.slerp(units[0], units[1], shares).numpy().reshape(*low.shape[:2], 4)
    return done


def _choose_times(chosen: CharacterPath, seconds: Array, per_second: float, joints: int) -> tuple[Fraction, Array]:
    """Return frames per second and the frames' times: the time codes, where all samples lie on them. FileFormatError
    where there would be too many."""
    check_extent(chosen.file, int(min(seconds[-1] - seconds[0], 1e15)), joints)
    codes = seconds * per_second
    if per_second <= _FASTEST_CODES and np.abs(codes - np.rint(codes)).max() < 1e-4:
        count = int(min(np.rint(codes[-1]) - np.rint(codes[0]) + 1, 1e15))
        check_extent(chosen.file, count, joints)
        return frame_rate_of(per_second), (round(codes[0]) + np.arange(count)) / per_second
    fps, times = sample_times(seconds)
    check_extent(chosen.file, len(times), joints)
    return fps, times


def _ask(path: str | PathLike[str], wanted: str) -> tuple[CharacterPath, Answer]:
    chosen = parse_character_path(path)
    if not is_installed():
        raise FileFormatError(chosen.file, "USD needs the package usd-core: pip install 'mapctl[usd]'")
    check_ordinary(chosen.file)
    request = {"armature": chosen.armature, "animation": chosen.animation, "wanted": wanted}
    return chosen, ask("usd", chosen.file, {**request, "most_poses": MAX_POSES, "most_bytes": MAX_FILE_BYTES})


def _read_frames(chosen: CharacterPath, found: Answer) -> RestFrames:
    """Read the rest frames: of the pose in which skins are bound, else of that of joints that nothing moves.

    UsdSkel says the former in the world of the time of binding, and skins as if that were the skeleton's space; it is
    taken for the space in which bones are as long as in the latter. A skeleton of several roots gets a root above them.
    """
    names, parents = list(found.said["names"]), list(found.said["parents"])
    outer, tables = found.arrays["outer"], dict(found.arrays)
    check_size(chosen.file, outer)
    if parents.count(-1) > 1:
        names = [found.said["path"].rpartition("/")[2], *names]
        parents = [-1, *(parent + 1 for parent in parents)]
        for kind in ("bind", "rest"):
            if kind in tables:
                tables[kind] = np.concatenate([np.eye(4)[None], tables[kind]])
    worlds = _choose_rest(chosen, tuple(parents), tables, outer)
    check_size(chosen.file, worlds)
    try:
        return RestFrames.of(tuple(make_unique(names)), tuple(parents), worlds, outer)
    except UnevenScaleError as error:
        what = f"skeleton {found.said['armature']!r}: {error.args[0]}; apply it and export again"
        raise FileFormatError(chosen.file, what) from None


def _choose_rest(chosen: CharacterPath, parents: tuple[int, ...], tables: dict[str, Array], outer: Array) -> Array:
    for kind in ("bind", "rest"):
        check_size(chosen.file, tables.get(kind, outer))
    rest = place_joints(chosen.file, parents, tables["rest"], outer) if "rest" in tables else None
    if "bind" not in tables:
        assert rest is not None
        return rest
    bound = outer @ tables["bind"]
    if rest is None:
        return bound
    for space in (outer, tables["stage"]):
        found = complete_bind_pose(parents, dict(enumerate(space @ tables["bind"])), rest)
        if found is not None:
            return found
    try:
        split_scales(parents, bound)
    except UnevenScaleError:
        return rest
    return bound


def _split(chosen: CharacterPath, matrices: Array) -> Array:
    """Return translation, rotation xyzw and scale (n, 1, 10) of matrices (n, 4, 4)."""
    try:
        parts = [split_scale(matrix) for matrix in matrices]
    except UnevenScaleError as error:
        raise FileFormatError(chosen.file, f"what the skeleton is in is moved so that {error.args[0]}") from None
    turns = rotations.from_matrix(torch.from_numpy(np.array([turn for turn, _ in parts])))
    scales = np.repeat([[scale] for _, scale in parts], 3, axis=1)
    return np.concatenate([matrices[:, :3, 3], turns.numpy(), scales], axis=1)[:, None]


def _rest_motion(chosen: CharacterPath, found: Answer, frames: RestFrames) -> Motion:
    source = _source(chosen, found, frames)
    return frames.to_motion(frames.matrices()[None], _REST_FPS, frames.skeleton({}), source)


def _source(chosen: CharacterPath, found: Answer, frames: RestFrames) -> CharacterSource:
    """Return where the motion is from; its nodes are PRIM.JOINT, of a root that was added PRIM alone."""
    said = found.said
    nodes = [said["path"]] * (len(frames.names) - len(said["joints"])) + [f"{said['path']}.{j}" for j in said["joints"]]
    return CharacterSource(
        chosen.file.resolve(),
        said["armature"],
        stamp_file(chosen.file),
        frames,
        tuple(nodes),
        said.get("animation"),
        armatures=said["armatures"],
        animations=said.get("animations", {}),
        metres_per_unit=said["metres_per_unit"],
    )
