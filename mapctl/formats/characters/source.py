"""What `Motion.source` keeps of a character's file, so that the character is written with the motion."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from os import PathLike
from pathlib import Path

from mapctl.errors import RequestError
from mapctl.formats.characters.rest_frames import RestFrames
from mapctl.motion import Motion

NEW_NODE = -1
"""What stands for the node of a joint that the file is yet to get."""


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
