"""Triangles of a USD stage that a skeleton carries."""

# pyright: reportAttributeAccessIssue=false

from pathlib import Path

import numpy as np
from pxr import Gf, Tf, Usd, UsdGeom, UsdSkel

from mapctl.isolated.child import Refusal
from mapctl.isolated.parts import MeshPart, strongest
from mapctl.isolated.polygons import mean_at_vertices, split_polygons
from mapctl.isolated.usd.looks import corner_colours
from mapctl.isolated.usd.skeletons import SkeletonPrim, read_value, walk

Array = np.ndarray
_MAX_CORNERS = 2**25


def read_parts(stage: Usd.Stage, skeleton: SkeletonPrim, folder: Path) -> list[MeshPart]:
    """Read the meshes that are bound to a skeleton; pictures lie in `folder` or below."""
    cache = UsdSkel.Cache()
    found: list[MeshPart] = []
    for prim in walk(stage):
        if not prim.IsA(UsdSkel.Root):
            continue
        root = UsdSkel.Root(prim)
        try:
            cache.Populate(root, Usd.TraverseInstanceProxies())
            bindings = cache.ComputeSkelBindings(root, Usd.TraverseInstanceProxies())
        except Tf.ErrorException:
            continue
        for binding in bindings:
            if binding.GetSkeleton().GetPrim() == skeleton.prim:
                for query in binding.GetSkinningTargets():
                    part = _read_mesh(query, skeleton, folder)
                    found += [] if part is None else [part]
    return found


def _read_mesh(query: UsdSkel.SkinningQuery, skeleton: SkeletonPrim, folder: Path) -> MeshPart | None:
    """Read a mesh; None for what is none, is not to be seen, or has no skin."""
    prim = query.GetPrim()
    mesh = UsdGeom.Mesh(prim)
    if not mesh or not query.HasJointInfluences() or not _is_seen(mesh):
        return None
    what = f"mesh {prim.GetName()!r}"
    points = _read_array(mesh.GetPointsAttr(), 3, np.float64)
    counts = _read_array(mesh.GetFaceVertexCountsAttr(), 1, np.int64)[:, 0]
    vertices = _read_array(mesh.GetFaceVertexIndicesAttr(), 1, np.int64)[:, 0]
    _check_topology(points, counts, vertices, what)
    holes = np.zeros(len(counts), bool)
    skipped = _read_array(mesh.GetHoleIndicesAttr(), 1, np.int64)[:, 0]
    holes[skipped[(skipped >= 0) & (skipped < len(counts))]] = True
    corners, _ = split_polygons(counts, holes)
    faces = vertices[corners].reshape(-1, 3)
    if str(read_value(mesh.GetOrientationAttr()) or "") == UsdGeom.Tokens.leftHanded:
        faces = faces[:, ::-1]
    joints, matrices = _read_palette(query, skeleton)
    rows, shares = _read_carriers(query, len(points), what)
    if rows.max(initial=0) >= len(joints) or rows.min(initial=0) < 0:
        raise Refusal(f"{what} names joint {rows.max()} of {len(joints)}")
    rgba = mean_at_vertices(corner_colours(mesh, counts, vertices, folder), vertices, len(points))
    return MeshPart(points, faces, rgba, joints, matrices, rows, shares)


def _is_seen(mesh: UsdGeom.Mesh) -> bool:
    seen = mesh.ComputeVisibility(Usd.TimeCode.EarliestTime()) != UsdGeom.Tokens.invisible
    return seen and mesh.ComputePurpose() in (UsdGeom.Tokens.default_, UsdGeom.Tokens.render)


def _check_topology(points: Array, counts: Array, vertices: Array, what: str) -> None:
    if len(vertices) > _MAX_CORNERS:
        raise Refusal(f"{what} has {len(vertices)} corners, allowed are {_MAX_CORNERS}")
    if counts.min(initial=0) < 0 or counts.sum() != len(vertices):
        raise Refusal(f"{what}: faceVertexCounts say {counts.sum()} corners, there are {len(vertices)}")
    if len(vertices) and (vertices.min() < 0 or vertices.max() >= len(points)):
        raise Refusal(f"{what} names vertex {vertices.max()} of {len(points)}")


def _read_palette(query: UsdSkel.SkinningQuery, skeleton: SkeletonPrim) -> tuple[Array, Array]:
    """Return joints (m,) of the skeleton in the mesh's order, and what takes the mesh to their frames (m, 4, 4)."""
    order = query.GetJointOrder()
    place = {joint: number for number, joint in enumerate(skeleton.joints)}
    names = skeleton.joints if order is None else [str(joint) for joint in order]
    joints = np.array([place.get(name, 0) for name in names])
    geometry = np.array(query.GetGeomBindTransform() or Gf.Matrix4d(1.0)).T
    bind = bind_matrices(skeleton)
    return joints, np.linalg.pinv(bind[joints]) @ geometry


def bind_matrices(skeleton: SkeletonPrim) -> Array:
    """Return (joints, 4, 4) of the pose in which skins are bound, else of that of joints that nothing moves, in the
    skeleton's space."""
    if skeleton.bind is not None:
        return skeleton.bind
    assert skeleton.rest is not None
    worlds = np.empty_like(skeleton.rest)
    for joint, parent in enumerate(skeleton.parents):
        worlds[joint] = skeleton.rest[joint] if parent < 0 else worlds[parent] @ skeleton.rest[joint]
    return worlds


def _read_carriers(query: UsdSkel.SkinningQuery, count: int, what: str) -> tuple[Array, Array]:
    """Return by vertex the indices in the mesh's joints and their shares, (n, k) each."""
    try:
        influences = query.ComputeJointInfluences(Usd.TimeCode.EarliestTime())
    except Tf.ErrorException:
        influences = None
    if not influences:
        raise Refusal(f"{what} has no sound skel:jointIndices and skel:jointWeights")
    indices, weights = (np.array(table) for table in influences)
    width = query.GetNumInfluencesPerComponent()
    if query.IsRigidlyDeformed():
        indices, weights = np.tile(indices[:width], count), np.tile(weights[:width], count)
    if width < 1 or len(indices) != count * width or len(weights) != count * width:
        raise Refusal(f"{what} has {count} vertices, and {len(indices)} joint indices of {width} each")
    return strongest(np.repeat(np.arange(count), width), indices.astype(np.int64), weights.astype(np.float64), count)


def _read_array(attribute: Usd.Attribute, width: int, dtype: type) -> Array:
    value = read_value(attribute)
    return np.array([] if value is None else value, dtype).reshape(-1, width)
