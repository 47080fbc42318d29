"""USD: characters of UsdSkel in, and motions out, on the character that they are of or on a mannequin.

Needs the package usd-core: pip install 'mapctl[usd]'.
"""

from os import PathLike
from pathlib import PurePath

from mapctl.errors import RequestError
from mapctl.formats.atomic import atomic_path
from mapctl.formats.bvh import check_finite
from mapctl.formats.characters.source import character_of
from mapctl.formats.usd import character
from mapctl.formats.usd.installed import is_installed
from mapctl.formats.usd.paths import joint_paths
from mapctl.formats.usd.reader import load, load_mesh, load_rest
from mapctl.motion import Motion

__all__ = ["check_installed", "is_installed", "joint_paths", "load", "load_mesh", "load_rest", "save"]


def check_installed(path: str | PathLike[str]) -> None:
    """Raise RequestError that names the extra if USD cannot be written here."""
    if not is_installed():
        raise RequestError(f"cannot write {path}: USD needs the package usd-core: pip install 'mapctl[usd]'")


def save(motion: Motion, path: str | PathLike[str]) -> None:
    """Write a motion: on the character whose file its skeleton came from, else on a mannequin.

    RequestError where the motion holds a NaN or USD is not installed.
    """
    check_installed(path)
    check_finite(motion, path)
    source = character_of(motion, PurePath(path).suffix)
    if source is not None:
        character.save(motion, path, source)
        return
    from mapctl.formats.usd import mannequin  # the extra may not be installed

    stage = mannequin.build_stage(motion, joint_paths(motion.skeleton))
    with atomic_path(path) as scratch:
        mannequin.export(stage, scratch)
