"""FBX in: a character's or a capture's joints, its rest pose, and an animation where the file has one."""

from fractions import Fraction
from importlib.util import find_spec
from os import PathLike

import numpy as np

from mapctl.errors import FileFormatError
from mapctl.formats.characters.bind_pose import complete_bind_pose
from mapctl.formats.characters.extracted import build_mesh, check_size, compose_transforms, frame_rate_of, place_joints
from mapctl.formats.characters.rest_frames import RestFrames, UnevenScaleError
from mapctl.formats.characters.selector import CharacterPath, note_animation, parse_character_path
from mapctl.formats.characters.source import CharacterSource, stamp_file
from mapctl.formats.text import MAX_POSES, check_ordinary, warn_once
from mapctl.isolated.parts import unpack_parts
from mapctl.isolated.process import Answer, ask
from mapctl.mesh.character_mesh import CharacterMesh
from mapctl.motion import Motion
from mapctl.skeleton import Skeleton

Array = np.ndarray
_REST_FPS = Fraction(30)


def is_installed() -> bool:
    """Return whether the package is installed."""
    return find_spec("ufbx") is not None


def load(path: str | PathLike[str]) -> Motion:
    """Read an animation of an .fbx file; one frame of the rest pose where it has none.

    `path` may end as `#ARMATURE`, `#ARMATURE/ANIMATION` or `#/ANIMATION`; by default the file's first animation that
    moves the armature is read, and a file of several armatures is refused, naming them. Joint frames are aligned with
    the world in the rest pose. FileFormatError says what is wrong with the file.
    """
    chosen, found = _ask(path, "motion")
    frames, skeleton = _read_skeleton(chosen, found)
    note_animation(chosen, found.said["animations"], found.said.get("animation"))
    if "local" not in found.arrays:
        return _rest_motion(chosen, found, frames, skeleton)
    outer = np.eye(4) + np.zeros((1, 4, 4))
    for one in np.moveaxis(compose_transforms(chosen.file, found.arrays["above"]), 1, 0):
        outer = outer @ one
    local = compose_transforms(chosen.file, found.arrays["local"])
    worlds = place_joints(chosen.file, frames.parents, local, outer)
    fps = frame_rate_of(found.said["rate"])
    return frames.to_motion(worlds, fps, skeleton, _source(chosen, found, frames))


def load_rest(path: str | PathLike[str]) -> Motion:
    """Read one frame of the rest pose, as `load` reads an animation."""
    chosen, found = _ask(path, "rest")
    return _rest_motion(chosen, found, *_read_skeleton(chosen, found))


def load_mesh(path: str | PathLike[str]) -> CharacterMesh:
    """Read the mesh of a character: what its skins carry, and what hangs on its joints rigidly. `path` chooses as in
    `load`. FileFormatError where the file has no triangles for the armature, or they are broken."""
    chosen, found = _ask(path, "mesh")
    frames, _ = _read_skeleton(chosen, found)
    parts = unpack_parts(found.arrays, found.said["parts"])
    return build_mesh(chosen.file, found.said["armature"], parts, frames)


def _ask(path: str | PathLike[str], wanted: str) -> tuple[CharacterPath, Answer]:
    chosen = parse_character_path(path)
    if not is_installed():
        raise FileFormatError(chosen.file, "FBX needs the package ufbx: pip install 'mapctl[fbx]'")
    check_ordinary(chosen.file)
    request = {"armature": chosen.armature, "animation": chosen.animation, "wanted": wanted, "most_poses": MAX_POSES}
    found = ask("fbx", chosen.file, request)
    if found.said["mesh_fault"]:
        warn_once(f"{chosen.file}: {found.said['mesh_fault']}; its joints and motion are read")
    return chosen, found


def _read_skeleton(chosen: CharacterPath, found: Answer) -> tuple[RestFrames, Skeleton]:
    """Read the rest frames: the pose in which skins are bound where bones are as long as the nodes', else the nodes';
    and the skeleton that is aligned with the world in them."""
    names, parents = tuple(found.said["names"]), tuple(found.said["parents"])
    worlds, outer = found.arrays["worlds"], found.arrays["outer"]
    check_size(chosen.file, worlds)
    for number in range(2):
        if f"bound_{number}" in found.arrays:
            joints, matrices = found.arrays[f"bound_joints_{number}"], found.arrays[f"bound_{number}"]
            bound = dict(zip(joints.tolist(), matrices, strict=True))
            check_size(chosen.file, matrices)
            worlds = complete_bind_pose(parents, bound, worlds)
            if worlds is not None:
                break
            worlds = found.arrays["worlds"]
    try:
        frames = RestFrames.of(names, parents, worlds, outer)
    except UnevenScaleError as error:
        raise FileFormatError(
            chosen.file, f"armature {found.said['armature']!r}: {error.args[0]}; apply it and export again"
        ) from None
    rests = frames.matrices()
    tips = zip(found.said["end_joints"], found.arrays.get("ends", ()), strict=True)
    return frames, frames.skeleton({joint: (rests[joint] @ np.append(end, 1.0))[:3] for joint, end in tips})


def _rest_motion(chosen: CharacterPath, found: Answer, frames: RestFrames, skeleton: Skeleton) -> Motion:
    return frames.to_motion(frames.matrices()[None], _REST_FPS, skeleton, _source(chosen, found, frames))


def _source(chosen: CharacterPath, found: Answer, frames: RestFrames) -> CharacterSource:
    said = found.said
    return CharacterSource(
        chosen.file.resolve(),
        said["armature"],
        stamp_file(chosen.file),
        frames,
        frames.names,
        said.get("animation"),
        armatures=said["armatures"],
        animations=said.get("animations", {}),
        metres_per_unit=said["metres_per_unit"],
    )
