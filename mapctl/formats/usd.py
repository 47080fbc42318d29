"""USD out: skeleton and animation by UsdSkel, and the mannequin as a skinned mesh.

Metres, Y up, one time code a frame from 0. Joints are paths, as UsdSkel wants (`hips/spine/chest`), of names that USD
allows; `jointNames` holds the file's own. The ending says whether the file is text (.usda) or packed (.usdc, .usd).
Needs the package usd-core: pip install 'mapctl[usd]'.
"""

import re
from importlib.util import find_spec
from os import PathLike

from mapctl.errors import RequestError
from mapctl.formats.atomic import atomic_path
from mapctl.formats.bvh import check_finite
from mapctl.motion import Motion
from mapctl.skeleton import Skeleton

ENDINGS = (".usda", ".usdc", ".usd")
"""Endings of USD files."""


def is_installed() -> bool:
    """Return whether the package is installed."""
    return find_spec("pxr") is not None


def check_installed(path: str | PathLike[str]) -> None:
    """Raise RequestError that names the extra if USD cannot be written here."""
    if not is_installed():
        raise RequestError(f"cannot write {path}: USD needs the package usd-core: pip install 'mapctl[usd]'")


def save(motion: Motion, path: str | PathLike[str]) -> None:
    """Write the motion with its skinned mannequin. RequestError where it holds a NaN or USD is not installed."""
    check_installed(path)
    check_finite(motion, path)
    from mapctl.formats import usd_stage  # the extra may not be installed

    stage = usd_stage.build_stage(motion, joint_paths(motion.skeleton))
    with atomic_path(path) as scratch:
        usd_stage.export(stage, scratch)


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
