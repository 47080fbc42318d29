"""Colours of a USD mesh: its own, else those of the UsdPreviewSurface that is bound to it, and that one's picture."""

# pyright: reportAttributeAccessIssue=false

from pathlib import Path

import numpy as np
from pxr import Ar, Tf, Usd, UsdGeom, UsdShade

from mapctl.isolated.pictures import decode_picture, encode_srgb, sample_picture
from mapctl.isolated.usd.layers import is_inside
from mapctl.isolated.usd.skeletons import read_value

Array = np.ndarray
_GREY = (0.8, 0.8, 0.8, 1.0)
_MAX_PICTURE_BYTES = 2**28


def corner_colours(mesh: UsdGeom.Mesh, counts: Array, vertices: Array, folder: Path) -> Array:
    """Return sRGB and opacity (corners, 4), 0 to 1, of a mesh's corners, of which face k has `counts[k]` and corner k
    is at vertex `vertices[k]`."""
    rgba = np.tile(np.array(_GREY), (len(vertices), 1))
    own = _corner_values(mesh, "displayColor", 3, counts, vertices)
    if own is not None:
        rgba[:, :3] = encode_srgb(own)
    uv = _corner_values(mesh, "st", 2, counts, vertices)
    for material, here in _find_materials(mesh, counts):
        colours = _material_colours(material, None if uv is None else uv[here], folder)
        if colours is not None:
            rgba[here] = colours
    return rgba.clip(0.0, 1.0)


def _corner_values(mesh: UsdGeom.Mesh, name: str, width: int, counts: Array, vertices: Array) -> Array | None:
    """Return a primvar's values at the corners; None where it has none, or not as many as it must."""
    primvar = UsdGeom.PrimvarsAPI(mesh).FindPrimvarWithInheritance(name)
    if not primvar or not primvar.HasValue():
        return None
    try:
        value = primvar.ComputeFlattened(Usd.TimeCode.EarliestTime())
        table = np.array(value, np.float64).reshape(-1, width)
    except (Tf.ErrorException, ValueError, TypeError):
        return None
    kind = primvar.GetInterpolation()
    if kind == UsdGeom.Tokens.constant:
        index = np.zeros(len(vertices), np.int64)
    elif kind == UsdGeom.Tokens.uniform:
        index = np.repeat(np.arange(len(counts)), counts)
    else:
        index = np.arange(len(vertices)) if kind == UsdGeom.Tokens.faceVarying else vertices
    usable = len(table) > index.max(initial=0) and np.isfinite(table).all()
    return table[index] if usable else None


def _find_materials(mesh: UsdGeom.Mesh, counts: Array) -> list[tuple[UsdShade.Material, Array]]:
    """Return materials and which corners (corners,) they are on: the mesh's own first, then those of its parts."""
    found = []
    whole = UsdShade.MaterialBindingAPI(mesh.GetPrim()).ComputeBoundMaterial()[0]
    if whole:
        found.append((whole, np.ones(int(counts.sum()), bool)))
    for subset in UsdGeom.Subset.GetAllGeomSubsets(mesh):
        material = UsdShade.MaterialBindingAPI(subset.GetPrim()).ComputeBoundMaterial()[0]
        faces = np.array(read_value(subset.GetIndicesAttr()) or [], np.int64)
        if material and subset.GetElementTypeAttr().Get() == UsdGeom.Tokens.face:
            of = np.zeros(len(counts), bool)
            of[faces[(faces >= 0) & (faces < len(counts))]] = True
            found.append((material, np.repeat(of, counts)))
    return found


def _material_colours(material: UsdShade.Material, uv: Array | None, folder: Path) -> Array | None:
    """Return one colour, or one for every corner; None for materials of other kinds."""
    shader = UsdShade.Shader(material.ComputeSurfaceSource()[0])
    if not shader or shader.GetIdAttr().Get() != "UsdPreviewSurface":
        return None
    entry = shader.GetInput("diffuseColor")
    if not entry:
        return np.array([*encode_srgb(np.full(3, 0.18)), 1.0])
    for attribute in UsdShade.Utils.GetValueProducingAttributes(entry):
        source = UsdShade.Shader(attribute.GetPrim())
        if source and source.GetIdAttr().Get() == "UsdUVTexture":
            picture = None if uv is None else _read_picture(source, folder)
            return None if picture is None or uv is None else sample_picture(picture, uv * (1, -1) + (0, 1))
        value = read_value(attribute)
        if value is not None and np.shape(value) == (3,):
            return np.array([*encode_srgb(np.array(value, np.float64)), 1.0])
    return None


def _read_picture(source: UsdShade.Shader, folder: Path) -> Array | None:
    entry = source.GetInput("file")
    value = read_value(entry.GetAttr()) if entry else None
    full = getattr(value, "resolvedPath", "")
    if not full or not is_inside(full, folder):
        return None
    asset = Ar.GetResolver().OpenAsset(Ar.ResolvedPath(full))
    if not asset or asset.GetSize() > _MAX_PICTURE_BYTES:
        return None
    with asset:
        return decode_picture(bytes(asset.GetBuffer()))
