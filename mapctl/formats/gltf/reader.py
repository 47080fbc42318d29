"""glTF, VRM and VRM animations in: a character's joints, its rest pose, and an animation where the file has one."""

from dataclasses import replace
from fractions import Fraction
from os import PathLike

from mapctl.errors import FileFormatError
from mapctl.formats.characters.rest_frames import RestFrames, chain_matrices
from mapctl.formats.characters.selector import CharacterPath, choose_name, note_animation, parse_character_path
from mapctl.formats.characters.source import CharacterSource, stamp_file
from mapctl.formats.gltf.animations import name_animations, read_tracks, sample_local_matrices, time_animations
from mapctl.formats.gltf.armatures import Armature, find_armatures, node_matrix, read_humanoid_names, read_rest_frames
from mapctl.formats.gltf.container import GltfFile, read_file
from mapctl.motion import Motion
from mapctl.skeleton import Skeleton

_REST_FPS = Fraction(30)


def load(path: str | PathLike[str]) -> Motion:
    """Read an animation of a character from a .glb, .gltf, .vrm or .vrma file; one frame of its rest pose where it has
    none.

    `path` may end as `#ARMATURE`, `#ARMATURE/ANIMATION` or `#/ANIMATION`; by default the file's first animation that
    moves the armature is read, and a file of several armatures is refused, naming them. Joint frames are aligned with
    the world in the rest pose. FileFormatError says what is wrong with the file.
    """
    chosen, gltf, armature = open_character(path)
    frames, skeleton = read_skeleton(gltf, armature)
    found = _find_animation(gltf, armature, chosen)
    if found is None:
        return _rest_motion(gltf, armature, frames, skeleton)
    name, tracks = found
    source = replace(_source(gltf, armature, frames, name), animations=time_animations(gltf, armature.nodes))
    note_animation(chosen, source.animations, name)
    fps, local = sample_local_matrices(gltf, armature.nodes, tracks)
    worlds = chain_matrices(armature.parents, local, frames.outer)
    return replace(frames.to_motion(worlds, fps, skeleton, source), licence=gltf.document.asset.licence)


def load_rest(path: str | PathLike[str]) -> Motion:
    """Read one frame of a character's rest pose, as `load` reads its animation."""
    _, gltf, armature = open_character(path)
    return _rest_motion(gltf, armature, *read_skeleton(gltf, armature))


def open_character(path: str | PathLike[str]) -> tuple[CharacterPath, GltfFile, Armature]:
    """Read a file and choose its armature."""
    chosen = parse_character_path(path)
    gltf = read_file(chosen.file)
    armatures = find_armatures(gltf)
    names = [armature.name for armature in armatures]
    return chosen, gltf, armatures[choose_name(chosen.file, names, chosen.armature, "armature", several=False)]


def read_skeleton(gltf: GltfFile, armature: Armature) -> tuple[RestFrames, Skeleton]:
    """Read the rest frames, and the skeleton that is aligned with the world in them."""
    frames = read_rest_frames(gltf, armature)
    worlds = frames.matrices()
    ends = {
        joint: (worlds[joint] @ node_matrix(gltf.document.nodes[node]))[:3, 3] for joint, node in armature.ends.items()
    }
    skeleton = frames.skeleton(ends)
    if float(skeleton.offsets.abs().max()) > 1e6:
        raise FileFormatError(gltf.path, f"armature {armature.name!r} is larger than 1000 km")
    return frames, skeleton


def _find_animation(gltf: GltfFile, armature: Armature, chosen: CharacterPath):
    """Return name and tracks of the chosen animation, or of the first that moves the armature; None where none does."""
    names = name_animations(gltf)
    if chosen.animation is not None:
        number = choose_name(gltf.path, names, chosen.animation, "animation", several=True)
        tracks = read_tracks(gltf, number, armature.nodes)
        if not tracks:
            raise FileFormatError(gltf.path, f"animation {names[number]!r} does not move {armature.name!r}")
        return names[number], tracks
    for number, name in enumerate(names):
        tracks = read_tracks(gltf, number, armature.nodes)
        if tracks:
            return name, tracks
    return None


def _rest_motion(gltf: GltfFile, armature: Armature, frames: RestFrames, skeleton: Skeleton) -> Motion:
    source = _source(gltf, armature, frames, None)
    return frames.to_motion(frames.matrices()[None], _REST_FPS, skeleton, source)


def _source(gltf: GltfFile, armature: Armature, frames: RestFrames, animation: str | None) -> CharacterSource:
    return CharacterSource(
        gltf.path.resolve(),
        armature.name,
        stamp_file(gltf.path),
        frames,
        armature.nodes,
        animation,
        read_humanoid_names(gltf, armature, frames.names),
        armature.all_names,
    )
