"""An FBX file as ufbx reads it: metres, Y up, right-handed, pivots and odd inheritance of scale resolved."""

import ctypes
from collections.abc import Iterator

import numpy as np
import ufbx

from mapctl.isolated.child import Refusal

Array = np.ndarray
NEWEST, OLDEST = 7799, 3000
"""Versions of FBX (7400 is 7.4) that are read."""
_MAX_ELEMENTS = 2**20


def open_scene(path: str, *, with_mesh: bool) -> tuple[ufbx.Scene, str]:
    """Read a file; also return what is wrong with its meshes, empty where nothing is.

    Refusal where it is no FBX, broken (but in its meshes, unless these are asked for), encrypted or of another version.
    """
    fault = ""
    try:
        scene = _load(path, ignore_embedded=not with_mesh)
    except Refusal:
        if with_mesh:
            raise
        scene, fault = _load(path, ignore_embedded=True, ignore_geometry=True), "its meshes are broken"
    version = scene.metadata.version
    if not OLDEST <= version <= NEWEST:
        raise Refusal(f"is FBX {version / 1000:g}, read are {OLDEST / 1000:g} to 7.7")
    count = sum(found.count for found in scene.metadata.warnings if found.type == ufbx.WarningType.INDEX_CLAMPED)
    if count:
        fault = f"{count} of its meshes' indices point at nothing, so they may look wrong"
    _keep_elements(scene)
    return scene, fault


def _load(path: str, *, ignore_embedded: bool, ignore_geometry: bool = False) -> ufbx.Scene:
    try:
        return ufbx.load_file(
            path,
            file_format=ufbx.FileFormat.FBX,
            target_axes=ufbx.axes_right_handed_y_up,
            target_unit_meters=1.0,
            space_conversion=ufbx.SpaceConversion.ADJUST_TRANSFORMS,
            inherit_mode_handling=ufbx.InheritModeHandling.COMPENSATE,
            index_error_handling=ufbx.IndexErrorHandling.CLAMP,
            load_external_files=False,
            ignore_embedded=ignore_embedded,
            ignore_geometry=ignore_geometry,
            generate_missing_normals=False,
            node_depth_limit=1024,
        )
    except ufbx.UnsupportedVersionError:
        raise Refusal("is FBX of a version that is not read; export it as 7.4 or 7.5") from None
    except ufbx.UnrecognizedFileFormatError:
        raise Refusal("is no FBX file") from None
    except ufbx.OutOfMemoryError:
        raise MemoryError from None
    except ufbx.UfbxError as error:
        raise Refusal(f"is no sound FBX file: {_reason(error)}") from None


def walk(node: ufbx.Node) -> Iterator[ufbx.Node]:
    """Go through a node and all below it, parents first, in the file's order."""
    waiting = [node]
    while waiting:
        one = waiting.pop()
        yield one
        waiting += reversed(list(one.children))


def above(node: ufbx.Node) -> ufbx.Node:
    """Return the node above one that is not the scene's root."""
    found = node.parent
    assert found is not None
    return found


def line_of(node: ufbx.Node) -> list[ufbx.Node]:
    """Return a node and all above it but the scene's root."""
    found = []
    while not node.is_root:
        found.append(node)
        node = above(node)
    return found


def to_matrix(columns: ufbx.Matrix) -> Array:
    """Return a (4, 4) matrix of ufbx's four columns."""
    matrix = np.eye(4)
    matrix[:3] = np.array(columns).T
    return matrix


def _keep_elements(scene: ufbx.Scene) -> None:
    """Keep the elements of a scene alive as long as the process.

    ufbx 0.0.5 hands out its elements without counting the reference, so that one is freed while it is in use, and the
    process crashes. Each gets more references than will ever be given back.
    """
    elements = scene.elements
    count = len(elements)
    if count > _MAX_ELEMENTS:
        raise Refusal(f"has {count} elements, allowed are {_MAX_ELEMENTS}")
    for number in range(count):
        element = elements[number]  # held while its count is changed
        ctypes.c_ssize_t.from_address(id(element)).value += 1 << 40


def _reason(error: ufbx.UfbxError) -> str:
    words = str(error).strip().splitlines()
    return words[0][:120] if words else type(error).__name__
