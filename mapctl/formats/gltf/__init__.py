"""glTF 2.0, VRM and VRM animations: characters in, and motions out, on their own character or on a mannequin."""

from os import PathLike
from pathlib import PurePath

from mapctl.errors import RequestError
from mapctl.formats.bvh import check_finite
from mapctl.formats.characters.source import character_of
from mapctl.formats.gltf import character, mannequin, vrma
from mapctl.formats.gltf.mesh import load_mesh
from mapctl.formats.gltf.reader import load, load_rest
from mapctl.motion import Motion

__all__ = ["load", "load_mesh", "load_rest", "save"]


def save(motion: Motion, path: str | PathLike[str]) -> None:
    """Write a motion as .glb or .vrm: on the character whose file its skeleton came from, else on a mannequin; as .vrma
    without either.

    RequestError where the motion holds a NaN, for a .vrm of a motion that is of no VRM character, and for a .vrma of
    one whose bones are not known.
    """
    check_finite(motion, path)
    ending = PurePath(path).suffix.lower()
    if ending == ".vrma":
        return vrma.save(motion, path)
    source = character_of(motion, ending)
    if ending == ".vrm" and (source is None or not source.humanoid):
        raise RequestError(f"cannot write {path}: a .vrm needs a character, as by --rig hero.vrm")
    if source is None:
        mannequin.save(motion, path)
    else:
        character.save(motion, path, source)
