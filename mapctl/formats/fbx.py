"""FBX in, by the package ufbx: characters and captures, as rigs and as clips. FBX is not written."""

from os import PathLike

import numpy as np

from mapctl.formats.character import (
    RestFrames,
    build_frames,
    build_mesh,
    check_size,
    complete_bind_pose,
    compose_transforms,
    describe_source,
    frame_rate_of,
    note_animation,
    place_joints,
    read_native,
)
from mapctl.formats.parts import CharacterPath
from mapctl.formats.text import warn_once
from mapctl.mesh.character_mesh import CharacterMesh
from mapctl.motion import Motion
from mapctl.skeleton import Skeleton


def load(path: str | PathLike[str]) -> Motion:
    """Read an animation of an .fbx file; one frame of the rest pose where it has none.

    `path` may end as `#ARMATURE`, `#ARMATURE/ANIMATION` or `#/ANIMATION`; by default the file's first animation that
    moves the armature is read, and a file of several armatures is refused, naming them. Joint frames are aligned with
    the world in the rest pose. FileFormatError says what is wrong with the file.
    """
    chosen, found = _read(path, "motion")
    frames, skeleton = _read_skeleton(chosen, found)
    note_animation(chosen, found.animations, found.animation)
    source = describe_source(chosen, found, frames, frames.names)
    if found.take is None:
        return frames.rest_motion(skeleton, source)
    outer = np.eye(4) + np.zeros((1, 4, 4))
    for one in np.moveaxis(compose_transforms(chosen.file, found.take.above), 1, 0):
        outer = outer @ one
    local = compose_transforms(chosen.file, found.take.local)
    worlds = place_joints(chosen.file, frames.parents, local, outer)
    return frames.to_motion(worlds, frame_rate_of(found.take.rate), skeleton, source)


def load_rest(path: str | PathLike[str]) -> Motion:
    """Read one frame of the rest pose, as `load` reads an animation."""
    chosen, found = _read(path, "rest")
    frames, skeleton = _read_skeleton(chosen, found)
    return frames.rest_motion(skeleton, describe_source(chosen, found, frames, frames.names))


def load_mesh(path: str | PathLike[str]) -> CharacterMesh:
    """Read the mesh of a character: what its skins carry, and what hangs on its joints rigidly. `path` chooses as in
    `load`. FileFormatError where the file has no triangles for the armature, or they are broken."""
    chosen, found = _read(path, "mesh")
    return build_mesh(chosen.file, found.armature, found.parts, _read_skeleton(chosen, found)[0])


def _read(path: str | PathLike[str], wanted: str):
    """Return what the path chooses, and the `fbx_scene.FbxCharacter` of it."""
    needed = "FBX needs the package ufbx: pip install 'mapctl[fbx]'"
    chosen, found = read_native(path, wanted, reader="fbx_scene", package="ufbx", needed=needed)
    if found.fault:
        warn_once(f"{chosen.file}: {found.fault}; its joints and motion are read")
    return chosen, found


def _read_skeleton(chosen: CharacterPath, found) -> tuple[RestFrames, Skeleton]:
    """Read the rest frames: the pose in which skins are bound where bones are as long as the nodes', else the nodes';
    and the skeleton that is aligned with the world in them."""
    parents, worlds = tuple(found.parents), found.worlds
    check_size(chosen.file, worlds)
    for bound in found.bound:
        check_size(chosen.file, np.stack(list(bound.values())))
        complete = complete_bind_pose(parents, bound, found.worlds)
        if complete is not None:
            worlds = complete
            break
    frames = build_frames(chosen.file, found.armature, found.names, parents, worlds, found.outer)
    rests = frames.matrices()
    tips = {joint: (rests[joint] @ np.append(end, 1.0))[:3] for joint, end in found.ends.items()}
    return frames, frames.skeleton(tips)
