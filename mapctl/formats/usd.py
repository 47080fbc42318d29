"""USD: characters of UsdSkel in, and motions out, on the character that they are of or on a mannequin.

Needs the package usd-core: pip install 'mapctl[usd]'.
"""

import re
from dataclasses import replace
from fractions import Fraction
from functools import partial
from importlib.util import find_spec
from os import PathLike
from pathlib import Path, PurePath

import numpy as np
import torch

from mapctl import rotations
from mapctl.errors import FileFormatError, RequestError
from mapctl.formats import sandbox
from mapctl.formats.atomic import atomic_path
from mapctl.formats.bvh import check_finite
from mapctl.formats.character import (
    CharacterSource,
    RestFrames,
    UnevenScaleError,
    build_frames,
    build_mesh,
    character_of,
    check_size,
    complete_bind_pose,
    compose_transforms,
    describe_source,
    frame_rate_of,
    note_animation,
    place_joints,
    read_native,
    sample_times,
    split_scale,
    split_scales,
)
from mapctl.formats.parts import CharacterPath, make_unique
from mapctl.formats.text import check_extent
from mapctl.mesh.character_mesh import CharacterMesh
from mapctl.motion import Motion
from mapctl.skeleton import Skeleton

Array = np.ndarray
_FASTEST_CODES = 240
"""Time codes per second up to which each is a frame; more are parts of frames."""
_NEEDED = "USD needs the package usd-core: pip install 'mapctl[usd]'"
_read = partial(read_native, reader="usd_stage", package="pxr", needed=_NEEDED)


def is_installed() -> bool:
    """Return whether the package is installed."""
    return find_spec("pxr") is not None


def check_installed(path: str | PathLike[str]) -> None:
    """Raise RequestError that names the extra if USD cannot be written here."""
    if not is_installed():
        raise RequestError(f"cannot write {path}: {_NEEDED}")


def load(path: str | PathLike[str]) -> Motion:
    """Read the animation of a skeleton from a .usd, .usda, .usdc or .usdz file; one frame of the rest pose where none
    is bound to it.

    `path` may end as `#SKELETON`, `#SKELETON/ANIMATION` or `#/ANIMATION`; a file of several skeletons is refused,
    naming them. Joint frames are aligned with the world in the rest pose. FileFormatError says what is wrong with the
    file.
    """
    chosen, found = _read(path, "motion")
    frames = _read_frames(chosen, found)
    note_animation(chosen, found.animations, found.animation)
    if found.poses is None:
        return frames.rest_motion(frames.skeleton({}), _source(chosen, found, frames))
    seconds, local, outers = found.poses.seconds, found.poses.local, found.poses.outer
    fps, times = _choose_times(chosen, seconds, found.per_second, len(frames.names))
    check_size(chosen.file, outers)
    local = compose_transforms(chosen.file, interpolate(seconds, local, times))
    if len(outers) > 1:
        outers = compose_transforms(chosen.file, interpolate(seconds, _split(chosen, outers), times))[:, 0]
    if len(frames.names) > local.shape[1]:
        local = np.concatenate([np.tile(np.eye(4), (len(times), 1, 1, 1)), local], axis=1)
    worlds = place_joints(chosen.file, frames.parents, local, outers)
    return frames.to_motion(worlds, fps, frames.skeleton({}), _source(chosen, found, frames))


def load_rest(path: str | PathLike[str]) -> Motion:
    """Read one frame of the rest pose, as `load` reads an animation."""
    chosen, found = _read(path, "rest")
    frames = _read_frames(chosen, found)
    return frames.rest_motion(frames.skeleton({}), _source(chosen, found, frames))


def load_mesh(path: str | PathLike[str]) -> CharacterMesh:
    """Read the meshes that are bound to a skeleton. `path` chooses as in `load`. FileFormatError where there is none,
    or they are broken."""
    chosen, found = _read(path, "mesh")
    frames = _read_frames(chosen, found)
    added = len(frames.names) - len(found.names)
    parts = [replace(part, joints=part.joints + added) for part in found.parts]
    return build_mesh(chosen.file, found.armature, parts, frames)


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


def _read_frames(chosen: CharacterPath, found) -> RestFrames:
    """Read the rest frames: of the pose in which skins are bound, else of that of joints that nothing moves.

    UsdSkel says the former in the world of the time of binding, and skins as if that were the skeleton's space; it is
    taken for the space in which bones are as long as in the latter. A skeleton of several roots gets a root above them.
    """
    names, parents, bind, rest = found.names, found.parents, found.bind, found.rest
    check_size(chosen.file, found.outer)
    if parents.count(-1) > 1:
        names = [found.path.rpartition("/")[2], *names]
        parents = [-1, *(parent + 1 for parent in parents)]
        bind, rest = (None if table is None else np.concatenate([np.eye(4)[None], table]) for table in (bind, rest))
    worlds = _choose_rest(chosen, tuple(parents), bind, rest, (found.outer, found.stage))
    check_size(chosen.file, worlds)
    return build_frames(chosen.file, found.armature, make_unique(names), tuple(parents), worlds, found.outer)


def _choose_rest(
    chosen: CharacterPath, parents: tuple[int, ...], bind: Array | None, rest: Array | None, spaces: tuple[Array, Array]
) -> Array:
    """Return world matrices (joints, 4, 4); `spaces` take the skeleton's and the stage's to the world."""
    outer = spaces[0]
    for table in (bind, rest):
        check_size(chosen.file, outer if table is None else table)
    worlds = None if rest is None else place_joints(chosen.file, parents, rest, outer)
    if bind is None:
        assert worlds is not None
        return worlds
    if worlds is None:
        return outer @ bind
    for space in spaces:
        found = complete_bind_pose(parents, dict(enumerate(space @ bind)), worlds)
        if found is not None:
            return found
    try:
        split_scales(parents, outer @ bind)
    except UnevenScaleError:
        return worlds
    return outer @ bind


def _split(chosen: CharacterPath, matrices: Array) -> Array:
    """Return translation, rotation xyzw and scale (n, 1, 10) of matrices (n, 4, 4)."""
    try:
        parts = [split_scale(matrix) for matrix in matrices]
    except UnevenScaleError as error:
        raise FileFormatError(chosen.file, f"what the skeleton is in is moved so that {error.args[0]}") from None
    turns = rotations.from_matrix(torch.from_numpy(np.array([turn for turn, _ in parts])))
    scales = np.repeat([[scale] for _, scale in parts], 3, axis=1)
    return np.concatenate([matrices[:, :3, 3], turns.numpy(), scales], axis=1)[:, None]


def _source(chosen: CharacterPath, found, frames: RestFrames) -> CharacterSource:
    """Return where the motion is from; its nodes are PRIM.JOINT, of a root that was added PRIM alone."""
    added = [found.path] * (len(frames.names) - len(found.joints))
    return describe_source(chosen, found, frames, (*added, *(f"{found.path}.{joint}" for joint in found.joints)))


def save(motion: Motion, path: str | PathLike[str]) -> None:
    """Write a motion: on the character whose file its skeleton came from, else on a mannequin.

    Of the character's file meshes, materials, skins, blend shapes and further prims stay as they are, and so do other
    animations; the one that the motion was read from is replaced. Layers that the file refers to stay files of their
    own where the new one lies in a folder that they are in; elsewhere, and of a .usdz, all becomes one layer.
    RequestError where the motion holds a NaN, the character's file has changed since it was read, or USD is not
    installed.
    """
    check_installed(path)
    check_finite(motion, path)
    source = character_of(motion, PurePath(path).suffix)
    if source is not None:
        return _save_character(motion, path, source)
    from mapctl.formats.usd_stage import build_stage, export

    stage = build_stage(motion, joint_paths(motion.skeleton))
    with atomic_path(path) as scratch:
        export(stage, scratch)


def _save_character(motion: Motion, path: str | PathLike[str], source: CharacterSource) -> None:
    from mapctl.formats.usd_stage import NewMotion, write_character

    source.check_unchanged()
    moved, turned, scales = _locals(motion, source)
    target = Path(path)
    new = NewMotion(
        skeleton=str(source.nodes[-1]).partition(".")[0],
        animation=source.animation,
        stem=target.stem,
        rate=float(motion.fps),
        translations=moved,
        rotations=turned,
        scales=scales,
        places=motion.joint_positions().numpy(),
        outer=source.frames.outer,
    )
    folder = str(target.resolve().parent)
    with atomic_path(path) as scratch:
        unwritten = sandbox.call(write_character, source.path, motion=new, scratch=str(scratch), folder=folder)
        if unwritten:
            raise OSError(unwritten)


def _locals(motion: Motion, source: CharacterSource) -> tuple[Array, Array, Array]:
    """Return translations (frames, joints, 3), rotations (frames, joints, 4) and scales (joints, 3) of the file's
    joints in their parents' frames; of a root that the file does not have, its joints' part."""
    frames = source.frames
    moved, turned = frames.to_locals(motion)
    _, unit = split_scale(frames.outer)
    above = np.array([unit if parent < 0 else frames.scales[parent] for parent in frames.parents])
    scales = np.repeat((frames.scales / above)[:, None], 3, axis=1)
    if "." in str(source.nodes[0]):
        return moved, turned, scales
    roots = [joint for joint, parent in enumerate(frames.parents) if parent == 0]
    own = torch.from_numpy(turned[:, :1])
    moved[:, roots] = moved[:, :1] + rotations.rotate(own, torch.from_numpy(moved[:, roots])).numpy()
    turned[:, roots] = rotations.multiply(own.expand(-1, len(roots), -1), torch.from_numpy(turned[:, roots])).numpy()
    return moved[:, 1:], turned[:, 1:], scales[1:]


def joint_paths(skeleton: Skeleton) -> list[str]:
    """Return each joint's USD path: the names from the root on, of letters, digits and _, unique among siblings."""
    found: list[str] = []
    for name, parent in zip(skeleton.names, skeleton.parents, strict=True):
        plain = re.sub(r"\W", "_", name, flags=re.ASCII) or "_"
        plain = f"_{plain}" if plain[0].isdigit() else plain
        above = f"{found[parent]}/" if parent >= 0 else ""
        again = (f"{plain}_{number}" for number in range(2, len(skeleton.names) + 2))
        word = plain if f"{above}{plain}" not in found else next(w for w in again if f"{above}{w}" not in found)
        found.append(above + word)
    return found
