"""USD: characters of UsdSkel in, and motions out, on the character that they are of or on a mannequin.

Needs the package usd-core. `find_character`, `write_character` and all that they call run in `mapctl.formats.sandbox`,
without torch.
"""

# The package loads its modules at run time and declares no types.
# pyright: reportAttributeAccessIssue=false

import errno
import itertools
import os
import re
from collections.abc import Collection
from dataclasses import dataclass, replace
from fractions import Fraction
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from pxr import Ar, Gf, Sdf, Tf, Usd, UsdGeom, UsdShade, UsdSkel, UsdUtils, Vt
from scipy.spatial.transform import Rotation

from mapctl.formats import parts, sandbox
from mapctl.formats.sandbox import Refusal
from mapctl.formats.text import MAX_FILE_BYTES
from mapctl.formats.units import frame_rate_of, sample_times

if TYPE_CHECKING:  # the sandbox has no torch
    from mapctl.formats.character import CharacterSource
    from mapctl.mesh.character_mesh import CharacterMesh
    from mapctl.motion import Motion
    from mapctl.skeleton import Skeleton

Array = np.ndarray
ENDINGS = (".usd", ".usda", ".usdc", ".usdz")
"""Endings of USD files."""
_ROOT = "/character"
_WRITE_FAULT = re.compile(r"rror occurred writing file: (.+?)'")
_REASON = re.compile(r"in file \S+ : '(.+?)'?\s*$", re.MULTILINE)
_MAX_LAYERS = 1000
_MAX_PICTURE_BYTES = 2**28
_TO_Y_UP = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
_FASTEST_CODES = 240
"""Time codes per second up to which each is a frame; more are parts of frames."""
_FIRST = Usd.TimeCode.EarliestTime()
_MARGIN = 0.3
"""Metres around the joints within which the body is."""


def read_character(path: Path, **choice: str | None) -> parts.FoundCharacter:
    """Read a character in a sandbox: see `find_character`."""
    return sandbox.call(find_character, path, **choice)


def find_character(path: str, *, armature: str | None, animation: str | None, wanted: str) -> parts.FoundCharacter:
    """Read a skeleton, and for `motion` its animation, for `mesh` its triangles. Refusal names why not."""
    try:
        stage = open_stage(path)
        listed, prims = find_skeletons(stage)
        number = parts.find_name(Path(path).name, listed, armature, "armature")
        skeleton = read_skeleton(prims[number])
        outer = world_of(skeleton.prim, _FIRST)
        path = str(skeleton.prim.GetPath())
        found = parts.FoundCharacter(
            armature=listed[number],
            armatures=listed,
            names=parts.make_unique(skeleton.names),
            nodes=[f"{path}.{joint}" for joint in skeleton.joints],
            parents=tuple(skeleton.parents),
            metres_per_unit=UsdGeom.GetStageMetersPerUnit(stage),
            worlds=_place_rest(skeleton, outer, stage_to_world(stage)),
            outer=outer,
        )
        if wanted == "motion":
            names, moving, bound = name_animations(stage, skeleton)
            codes = [[code for one in _attributes_of(prim) for code in one.GetTimeSamples()] for prim in moving]
            spans = [max(own, default=0.0) - min(own, default=0.0) for own in codes]
            per_second = stage.GetTimeCodesPerSecond() or 1.0
            found.animations = {name: span / per_second for name, span in zip(names, spans, strict=True)}
            if animation is not None or bound:
                chosen = parts.find_name("", names, animation, "animation")
                found.animation = names[chosen]
                found.motion = _sample(stage, skeleton, moving[chosen], names[chosen])
        if wanted == "mesh":
            found.parts = _read_parts(stage, skeleton, Path(path).resolve().parent)
    except (Tf.ErrorException, UnicodeDecodeError) as error:
        raise Refusal(f"is no sound USD file: {first_reason(error)}") from None
    return _add_root(found, path) if skeleton.parents.count(-1) > 1 else found


def _place_rest(skeleton: "SkeletonPrim", outer: Array, stage: Array) -> Array:
    """Return the world matrices (joints, 4, 4) of the pose in which skins are bound, else of that of joints that
    nothing moves. `outer` and `stage` take the skeleton's and the stage's space to the world.

    UsdSkel defines the former in the world of the time of binding, and skins as if that were the skeleton's space; it
    is taken for the space in which bones are as long as in the latter.
    """
    bind, parents = skeleton.bind, skeleton.parents
    parts.check_size(outer, bind, skeleton.rest)
    worlds = parts.chain_matrices(parents, skeleton.rest, outer)
    found = parts.complete_bind_pose(parents, (dict(enumerate(space @ bind)) for space in (outer, stage)), worlds)
    if found is not None:
        return found
    try:
        parts.split_scales(parents, outer @ bind)
    except parts.UnevenScaleError:
        return worlds
    return outer @ bind


def _add_root(found: parts.FoundCharacter, path: str) -> parts.FoundCharacter:
    """Put a joint above those of a skeleton of several roots."""
    found.names = parts.make_unique([path.rpartition("/")[2], *found.names])
    found.nodes = [path, *found.nodes]
    found.parents = (-1, *(parent + 1 for parent in found.parents))
    found.worlds = np.concatenate([found.outer[None], found.worlds])
    found.parts = [replace(part, joints=part.joints + 1) for part in found.parts]
    return found


def open_stage(path: str) -> Usd.Stage:
    """Open a file with all that it refers to. Refusal where it is broken, or names layers that are not there, lie
    elsewhere, or are larger than files may be."""
    root = _open_layer(path)
    _check_layers(root, Path(path).resolve().parent)
    stage = Usd.Stage.Open(root)
    if not stage:
        raise Refusal("is no sound USD file")
    return stage


def _open_layer(path: str) -> Sdf.Layer:
    layer = Sdf.Layer.FindOrOpen(path)
    if not layer:
        raise Refusal("is no sound USD file")
    return layer


def _check_layers(root: Sdf.Layer, folder: Path) -> None:
    """Refuse layers that the root layer names, or those name, unless they are sound files in the folder."""
    waiting, seen = [root], {root.identifier}
    while waiting:
        layer = waiting.pop()
        assets = itertools.chain(*UsdUtils.ExtractExternalReferences(layer.identifier))  # of value clips, too
        layers = [*layer.GetCompositionAssetDependencies(), *(a for a in assets if a.lower().endswith(ENDINGS))]
        for name in sorted(set(filter(None, layers))):
            full = layer.ComputeAbsolutePath(name)
            if full in seen:
                continue
            seen.add(full)
            if len(seen) > _MAX_LAYERS:
                raise Refusal(f"is made of more than {_MAX_LAYERS} layers")
            if not is_inside(full, folder):
                raise Refusal(f"names {name!r}, which is not in its folder; such files are not read")
            if "#" in name:  # the pattern of value clips, which USD looks for where it leads
                continue
            outer, inner = Ar.SplitPackageRelativePathOuter(full)
            if not Path(outer).is_file() or (inner and not Ar.GetResolver().Resolve(full)):
                raise Refusal(f"names {name!r}, which is not there")
            if Path(outer).stat().st_size > MAX_FILE_BYTES:
                raise Refusal(f"names {name!r}, which has more than {MAX_FILE_BYTES >> 20} MiB")
            waiting.append(_open_layer(full))


def is_inside(full: str, folder: Path) -> bool:
    """Return whether a resolved asset path is a file in the folder or below, or within such a package."""
    outer = Ar.SplitPackageRelativePathOuter(full)[0]
    return "://" not in outer and Path(outer).resolve().is_relative_to(folder)


def first_reason(error: Exception) -> str:
    """Return the reason that USD's many lines of an error hold, in short."""
    try:
        text = str(error)
    except UnicodeDecodeError:  # USD quotes bytes of a broken file
        return "it holds what is no text"
    found = _REASON.search(text)
    text = found[1] if found else text
    return " ".join(text.split())[:160] or "no reason given"


@dataclass(frozen=True, eq=False)
class SkeletonPrim:
    """A UsdSkel.Skeleton, read."""

    prim: Usd.Prim
    joints: list[str]
    names: list[str]
    parents: list[int]
    """Index of each joint's parent, -1 where it has none."""
    bind: Array
    """(joints, 4, 4) of the pose in which skins are bound, in the skeleton's space; `rest` where it has none."""
    rest: Array
    """(joints, 4, 4) of the pose of joints that nothing moves, in their parents' frames; `bind` where it has none."""


def find_skeletons(stage: Usd.Stage) -> tuple[list[str], list[Usd.Prim]]:
    """Find the skeletons of a stage, those in instances too, with unique names. Refusal where there is none."""
    prims = [prim for prim in walk(stage) if prim.IsA(UsdSkel.Skeleton)]
    if not prims:
        raise Refusal("has no Skeleton (UsdSkel), so nothing in it marks a character's joints")
    return parts.make_unique([prim.GetName() for prim in prims]), prims


def walk(stage: Usd.Stage) -> Usd.PrimRange:
    """Go through the prims of a stage, those in instances too."""
    return Usd.PrimRange.Stage(stage, Usd.TraverseInstanceProxies())


def read_skeleton(prim: Usd.Prim) -> SkeletonPrim:
    """Read a skeleton's joints and poses. Refusal where they are no tree, or its tables do not fit together."""
    skeleton, where = UsdSkel.Skeleton(prim), f"skeleton {prim.GetName()!r}"
    joints = [str(joint) for joint in read_value(skeleton.GetJointsAttr()) or ()]
    if not 1 <= len(joints) <= parts.MAX_JOINTS:
        raise Refusal(f"{where} has {len(joints)} joints, allowed are 1 to {parts.MAX_JOINTS}")
    parents = _find_parents(joints, where)
    said = [str(name) for name in read_value(skeleton.GetJointNamesAttr()) or ()]
    bind = _read_matrices(skeleton.GetBindTransformsAttr(), len(joints), where)
    rest = _read_matrices(skeleton.GetRestTransformsAttr(), len(joints), where)
    if rest is None:
        if bind is None:
            raise Refusal(f"{where} has neither bindTransforms nor restTransforms")
        rest = np.linalg.pinv([np.eye(4) if parent < 0 else bind[parent] for parent in parents]) @ bind
    bind = parts.chain_matrices(parents, rest, np.eye(4)) if bind is None else bind
    if len(said) != len(joints) or len(set(said)) < len(said) or not all(said):
        said = [joint.rpartition("/")[2] for joint in joints]
    names = said if len(set(said)) == len(joints) else joints
    return SkeletonPrim(prim, joints, names, parents, bind, rest)


def world_of(prim: Usd.Prim, time: Usd.TimeCode) -> Array:
    """Return what takes a prim's space to the world of Y up and metres at a time, (4, 4)."""
    stage = prim.GetStage()
    matrix = np.array(UsdGeom.XformCache(time).GetLocalToWorldTransform(prim)).T
    return stage_to_world(stage) @ matrix


def stage_to_world(stage: Usd.Stage) -> Array:
    """Return what takes the stage's up axis and unit to Y up and metres, (4, 4)."""
    unit = UsdGeom.GetStageMetersPerUnit(stage)
    if not (np.isfinite(unit) and 1e-9 < unit < 1e9):
        raise Refusal(f"metersPerUnit is {unit:g}")
    turn = _TO_Y_UP if UsdGeom.GetStageUpAxis(stage) == UsdGeom.Tokens.z else np.eye(4)
    return np.diag([unit, unit, unit, 1.0]) @ turn


def read_value(attribute: Usd.Attribute, time: Usd.TimeCode | None = None):
    """Return an attribute's value at a time, else its default or earliest one; None where it has none that is known."""
    try:
        value = attribute.Get(Usd.TimeCode.EarliestTime() if time is None else time)
    except Tf.ErrorException:
        return None
    return None if isinstance(value, Sdf.UnregisteredValue) else value


def _find_parents(joints: list[str], where: str) -> list[int]:
    """Return each joint's nearest one above it in its path, which must come before it."""
    index_of = {joint: number for number, joint in enumerate(joints)}
    if len(index_of) < len(joints):
        raise Refusal(f"{where} names a joint twice")
    parents = []
    for number, joint in enumerate(joints):
        words = joint.split("/")
        above = ("/".join(words[:length]) for length in range(len(words) - 1, 0, -1))
        parent = next((index_of[path] for path in above if path in index_of), -1)
        if parent >= number:
            raise Refusal(f"{where}: joint {joint!r} comes before the joint above it")
        parents.append(parent)
    return parents


def _read_matrices(attribute: Usd.Attribute, count: int, where: str) -> Array | None:
    value = read_value(attribute)
    if value is None or not len(value):
        return None
    if len(value) != count or not np.isfinite(value).all():
        raise Refusal(f"{where}: {attribute.GetName()} are not {count} matrices of finite numbers")
    return np.array(value, np.float64).reshape(count, 4, 4).transpose(0, 2, 1)


def name_animations(stage: Usd.Stage, skeleton: SkeletonPrim) -> tuple[list[str], list[Usd.Prim], bool]:
    """Return the animations that fit a skeleton, with unique names, and whether the first is bound to it."""
    bound = UsdSkel.BindingAPI(skeleton.prim).GetInheritedAnimationSource()
    own = set(skeleton.joints)
    found = [bound] if bound and bound.IsA(UsdSkel.Animation) else []
    for prim in walk(stage):
        if prim.IsA(UsdSkel.Animation) and prim not in found and _animated_joints(prim) & own:
            found.append(prim)
    return parts.make_unique([prim.GetName() for prim in found]), found, bool(bound and found[:1] == [bound])


def animated_placement(prim: Usd.Prim) -> list[float]:
    """Return the time codes at which the placement of a prim, or of what it is in, changes; none where it does not."""
    times: set[float] = set()
    while prim and not prim.IsPseudoRoot():
        form = UsdGeom.Xformable(prim)
        if form and form.TransformMightBeTimeVarying():
            times.update(form.GetTimeSamples())
        prim = prim.GetParent()
    return sorted(times)


def _animated_joints(prim: Usd.Prim) -> set[str]:
    return {str(joint) for joint in read_value(UsdSkel.Animation(prim).GetJointsAttr()) or ()}


def _attributes_of(prim: Usd.Prim) -> list[Usd.Attribute]:
    animation = UsdSkel.Animation(prim)
    return [animation.GetTranslationsAttr(), animation.GetRotationsAttr(), animation.GetScalesAttr()]


def _sample(stage: Usd.Stage, skeleton: SkeletonPrim, prim: Usd.Prim, name: str) -> tuple[Fraction, Array]:
    """Return frames per second, and world matrices (frames, joints, 4, 4); of several roots with the joint above."""
    attributes, placed, what = _attributes_of(prim), animated_placement(skeleton.prim), f"animation {name!r}"
    codes = np.unique([*placed, *(code for attribute in attributes for code in attribute.GetTimeSamples())] or [0.0])
    per_second = stage.GetTimeCodesPerSecond()
    if not (np.isfinite(per_second) and 1e-3 <= per_second <= 1e6):
        raise Refusal(f"timeCodesPerSecond is {per_second:g}")
    if not np.isfinite(codes).all():
        raise Refusal(f"{what} has times that are not finite")
    fps, times = _choose_times(codes, per_second, len(skeleton.joints))
    local = parts.compose_transforms(_sample_joints(skeleton, UsdSkel.Animation(prim), attributes, times, what))
    outer = np.array(
        [world_of(skeleton.prim, Usd.TimeCode(time)) for time in (times if placed else times[:1]).tolist()]
    )
    parts.check_size(outer)
    for matrix in outer:
        parts.split_scale(matrix)
    worlds = parts.chain_matrices(skeleton.parents, local, outer)
    if skeleton.parents.count(-1) > 1:
        worlds = np.concatenate([np.broadcast_to(outer, (len(times), 4, 4))[:, None], worlds], axis=1)
    return fps, worlds


def _choose_times(codes: Array, per_second: float, joints: int) -> tuple[Fraction, Array]:
    """Return frames per second and the frames' time codes: whole ones, where all samples are at such. Refusal where
    there would be too many."""
    span = codes[-1] - codes[0]
    parts.check_poses(int(min(span / per_second, 1e15)), joints)
    if per_second <= _FASTEST_CODES and np.abs(codes - np.rint(codes)).max() < 1e-4:
        count = int(min(np.rint(span), 1e15)) + 1
        parts.check_poses(count, joints)
        return frame_rate_of(per_second), round(codes[0]) + np.arange(count, dtype=float)
    fps, seconds = sample_times(codes / per_second)
    parts.check_poses(len(seconds), joints)
    return fps, seconds * per_second


def _sample_joints(
    skeleton: SkeletonPrim, animation: UsdSkel.Animation, attributes: list[Usd.Attribute], times: Array, what: str
) -> Array:
    """Return the skeleton's joints (times, joints, 10); those that the animation leaves out are at rest."""
    moved = [str(joint) for joint in read_value(animation.GetJointsAttr()) or ()]
    index_of = {joint: number for number, joint in enumerate(skeleton.joints)}
    here = [number for number, joint in enumerate(moved) if joint in index_of]
    there = [index_of[moved[number]] for number in here]
    if not here:
        raise Refusal(f"{what} moves none of the skeleton's joints")
    local = np.tile(_rest_parts(skeleton), (len(times), 1, 1))
    for attribute, columns in zip(attributes, (slice(0, 3), slice(3, 7), slice(7, 10)), strict=True):
        varies = len(attribute.GetTimeSamples()) > 1
        for key, time in enumerate(times.tolist() if varies else times[:1].tolist()):
            value = read_value(attribute, Usd.TimeCode(time))
            if value is None or not len(value):
                continue
            if len(value) != len(moved):
                raise Refusal(f"{what} has {len(moved)} joints and {len(value)} {attribute.GetName()}")
            table = np.array(value, np.float64).reshape(len(moved), -1)
            local[key if varies else slice(None), there, columns] = table[here]
    return local


def _rest_parts(skeleton: SkeletonPrim) -> Array:
    """Return translation, rotation xyzw and scale (joints, 10) of the pose of joints that nothing moves."""
    matrices = skeleton.rest
    scales = np.linalg.norm(matrices[:, :3, :3], axis=1)
    scales *= np.where(np.linalg.det(matrices[:, :3, :3]) < 0, -1.0, 1.0)[:, None]
    turns = matrices[:, :3, :3] / np.where(abs(scales) > 1e-12, scales, 1.0)[:, None, :]
    turns = Rotation.from_matrix(parts.nearest_rotations(turns)).as_quat()
    return np.concatenate([matrices[:, :3, 3], turns, scales], axis=1)


def _corner_colours(mesh: UsdGeom.Mesh, counts: Array, vertices: Array, folder: Path) -> Array:
    """Return sRGB and opacity (corners, 4), 0 to 1, of a mesh's corners, of which face k has `counts[k]` and corner k
    is at vertex `vertices[k]`."""
    rgba = np.tile(np.array(parts.GREY), (len(vertices), 1))
    own = _corner_values(mesh, "displayColor", 3, counts, vertices)
    if own is not None:
        rgba[:, :3] = parts.encode_srgb(own)
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
        value = primvar.ComputeFlattened(_FIRST)
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
        return np.array([*parts.encode_srgb(np.full(3, 0.18)), 1.0])
    for attribute in UsdShade.Utils.GetValueProducingAttributes(entry):
        source = UsdShade.Shader(attribute.GetPrim())
        if source and source.GetIdAttr().Get() == "UsdUVTexture":
            picture = None if uv is None else _read_picture(source, folder)
            return None if picture is None or uv is None else parts.sample_picture(picture, uv * (1, -1) + (0, 1))
        value = read_value(attribute)
        if value is not None and np.shape(value) == (3,):
            return np.array([*parts.encode_srgb(np.array(value, np.float64)), 1.0])
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
        return parts.decode_picture(bytes(asset.GetBuffer()))


def _read_parts(stage: Usd.Stage, skeleton: SkeletonPrim, folder: Path) -> list[parts.MeshPart]:
    """Read the meshes that are bound to a skeleton; pictures lie in `folder` or below."""
    cache = UsdSkel.Cache()
    found: list[parts.MeshPart] = []
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


def _read_mesh(query: UsdSkel.SkinningQuery, skeleton: SkeletonPrim, folder: Path) -> parts.MeshPart | None:
    """Read a mesh; None for what is none, is not to be seen, or has no skin."""
    prim = query.GetPrim()
    mesh = UsdGeom.Mesh(prim)
    if not mesh or not query.HasJointInfluences():
        return None
    seen = mesh.ComputeVisibility(_FIRST) != UsdGeom.Tokens.invisible
    if not seen or mesh.ComputePurpose() not in (UsdGeom.Tokens.default_, UsdGeom.Tokens.render):
        return None
    what = f"mesh {prim.GetName()!r}"
    points = _read_array(mesh.GetPointsAttr(), 3, np.float64)
    counts = _read_array(mesh.GetFaceVertexCountsAttr(), 1, np.int64)[:, 0]
    vertices = _read_array(mesh.GetFaceVertexIndicesAttr(), 1, np.int64)[:, 0]
    if len(vertices) > parts.MAX_CORNERS:
        raise Refusal(f"{what} has {len(vertices)} corners, allowed are {parts.MAX_CORNERS}")
    named = vertices.min(initial=0) >= 0 and vertices.max(initial=-1) < len(points)
    if counts.min(initial=0) < 0 or counts.sum() != len(vertices) or not named:
        raise Refusal(f"{what}: its faceVertexCounts or faceVertexIndices do not fit its {len(points)} points")
    holes = np.zeros(len(counts), bool)
    skipped = _read_array(mesh.GetHoleIndicesAttr(), 1, np.int64)[:, 0]
    holes[skipped[(skipped >= 0) & (skipped < len(counts))]] = True
    corners, _ = parts.split_polygons(counts, holes)
    faces = vertices[corners].reshape(-1, 3)
    if str(read_value(mesh.GetOrientationAttr()) or "") == UsdGeom.Tokens.leftHanded:
        faces = faces[:, ::-1]
    joints, matrices = _read_palette(query, skeleton)
    rows, shares = _read_carriers(query, len(points), what)
    if rows.max(initial=0) >= len(joints) or rows.min(initial=0) < 0:
        raise Refusal(f"{what} names joint {rows.max()} of {len(joints)}")
    rgba = parts.mean_at_vertices(_corner_colours(mesh, counts, vertices, folder), vertices, len(points))
    return parts.MeshPart(points, faces, rgba, joints, matrices, rows, shares)


def _read_palette(query: UsdSkel.SkinningQuery, skeleton: SkeletonPrim) -> tuple[Array, Array]:
    """Return joints (m,) of the skeleton in the mesh's order, and what takes the mesh to their frames (m, 4, 4)."""
    order = query.GetJointOrder()
    index_of = {joint: number for number, joint in enumerate(skeleton.joints)}
    names = skeleton.joints if order is None else [str(joint) for joint in order]
    joints = np.array([index_of.get(name, 0) for name in names])
    geometry = np.array(query.GetGeomBindTransform() or Gf.Matrix4d(1.0)).T
    return joints, np.linalg.pinv(skeleton.bind[joints]) @ geometry


def _read_carriers(query: UsdSkel.SkinningQuery, count: int, what: str) -> tuple[Array, Array]:
    """Return by vertex the indices in the mesh's joints and their shares, (n, k) each."""
    try:
        influences = query.ComputeJointInfluences(_FIRST)
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
    return parts.strongest(
        np.repeat(np.arange(count), width), indices.astype(np.int64), weights.astype(np.float64), count
    )


def _read_array(attribute: Usd.Attribute, width: int, dtype: type) -> Array:
    value = read_value(attribute)
    return np.array([] if value is None else value, dtype).reshape(-1, width)


def save(motion: "Motion", path: str | PathLike[str]) -> None:
    """Write a motion: on the character whose file its skeleton came from, else on a mannequin.

    Of the character's file meshes, materials, skins, blend shapes and further prims stay as they are, and so do other
    animations; the one that the motion was read from is replaced. Layers that the file refers to stay files of their
    own where the new one lies in a folder that they are in; elsewhere, and of a .usdz, all becomes one layer.
    RequestError where the character's file has changed since it was read.
    """
    from mapctl.formats.atomic import atomic_path
    from mapctl.formats.character import character_of

    target = Path(path)
    source = character_of(motion, target.suffix)
    if source is None:
        stage = _build_stage(motion)
        with atomic_path(path) as scratch:
            _export(stage, scratch)
        return
    moved, turned, scales = _find_locals(motion, source)
    new = NewMotion(
        skeleton=str(source.nodes[-1]).partition(".")[0],
        replaced=source.animation,
        stem=target.stem,
        rate=float(motion.fps),
        translations=moved,
        rotations=turned,
        scales=scales,
        positions=motion.joint_positions().numpy(),
        outer=source.frames.outer,
    )
    folder = str(target.resolve().parent)
    with atomic_path(path) as scratch:
        unwritten = sandbox.call(write_character, source.path, motion=new, scratch=str(scratch), folder=folder)
        if unwritten:
            raise OSError(unwritten)


def _find_locals(motion: "Motion", source: "CharacterSource") -> tuple[Array, Array, Array]:
    """Return translations (frames, joints, 3), rotations (frames, joints, 4) and scales (joints, 3) of the file's
    joints in their parents' frames; of a root that the file does not have, its joints' part."""
    import torch

    from mapctl import rotations

    frames = source.frames
    moved, turned = frames.to_locals(motion)
    _, unit = parts.split_scale(frames.outer)
    above = np.array([unit if parent < 0 else frames.scales[parent] for parent in frames.parents])
    scales = np.repeat((frames.scales / above)[:, None], 3, axis=1)
    if "." in str(source.nodes[0]):
        return moved, turned, scales
    roots = [joint for joint, parent in enumerate(frames.parents) if parent == 0]
    own = torch.from_numpy(turned[:, :1])
    moved[:, roots] = moved[:, :1] + rotations.rotate(own, torch.from_numpy(moved[:, roots])).numpy()
    turned[:, roots] = rotations.multiply(own, torch.from_numpy(turned[:, roots])).numpy()
    return moved[:, 1:], turned[:, 1:], scales[1:]


@dataclass(eq=False, kw_only=True)
class NewMotion:
    """A motion of a skeleton, to be written."""

    skeleton: str
    replaced: str | None
    """Name of the animation that it was read from."""
    stem: str
    """Name of a new one."""
    rate: float
    translations: Array
    """(frames, joints, 3) of the skeleton's joints in the file's order, in their parents' frames."""
    rotations: Array
    """(frames, joints, 4) xyzw."""
    scales: Array
    """(joints, 3)"""
    positions: Array
    """(frames, joints, 3) in the world, metres."""
    outer: Array
    """(4, 4) what takes the skeleton's space to the world, as it was read."""


def write_character(path: str, *, motion: NewMotion, scratch: str, folder: str) -> str:
    """Write a character's file with a motion to `scratch`, which is for a `folder`; all else of it stays as it is.
    Return why that cannot be, empty where it was written."""
    try:
        stage = open_stage(path)
    except (Tf.ErrorException, UnicodeDecodeError) as error:
        raise Refusal(f"is no sound USD file: {first_reason(error)}") from None
    try:
        _copy_stage(stage, scratch, Path(folder).resolve())
        edited = Usd.Stage.Open(scratch)
        _add_motion(edited, motion)
        return "" if edited.GetRootLayer().Save() else "USD gives no reason"
    except (Tf.ErrorException, RuntimeError) as error:
        return first_reason(error)


def _copy_stage(stage: Usd.Stage, scratch: str, folder: Path) -> None:
    """Copy the file's root layer; of a package, and where other layers are not in the new file's folder, all of them in
    one, as USD composes them."""
    root = stage.GetRootLayer()
    used = [layer.realPath for layer in stage.GetUsedLayers() if layer.realPath and layer != root]
    apart = root.realPath.lower().endswith(".usdz") or any(not is_inside(name, folder) for name in used)
    copied = stage.Flatten(False) if apart else Sdf.Layer.CreateAnonymous(".usda")
    if not apart:
        copied.TransferContent(root)

    def move(name: str) -> str:
        """Return how a file in the new folder names what this one names."""
        outer, inner = Ar.SplitPackageRelativePathOuter(root.ComputeAbsolutePath(name) if name else "")
        if not outer or not Path(outer).is_file():
            return name
        moved = Path(os.path.relpath(Path(outer).resolve(), folder)).as_posix()
        moved = moved if moved.startswith("..") else f"./{moved}"
        return Ar.JoinPackageRelativePath([moved, inner]) if inner else moved

    if apart or Path(root.realPath).resolve().parent != folder:
        UsdUtils.ModifyAssetPaths(copied, move)
    copied.Export(scratch)


def _add_motion(stage: Usd.Stage, motion: NewMotion) -> None:
    prim = stage.GetPrimAtPath(motion.skeleton)
    if not prim or not prim.IsA(UsdSkel.Skeleton):
        raise Refusal(f"has no Skeleton {motion.skeleton}")
    skeleton = read_skeleton(_as_own(stage, prim))
    names, prims, _ = name_animations(stage, skeleton)
    replaced = prims[names.index(motion.replaced)] if motion.replaced in names else None
    codes = _set_times(stage, replaced, len(motion.translations), motion.rate)
    moved, turned = _place_roots(skeleton, motion, codes)
    if replaced is None:
        taken = {child.GetName() for child in skeleton.prim.GetAllChildren()}
        name = _plain_name(motion.stem, taken)
        animation = UsdSkel.Animation.Define(stage, skeleton.prim.GetPath().AppendChild(name))
    else:
        animation = UsdSkel.Animation(_as_own(stage, replaced))
    _write_animation(animation, skeleton.prim, skeleton.joints, moved, turned, motion.scales, codes)
    _set_extent(skeleton.prim, motion.positions)


def _write_animation(
    animation: UsdSkel.Animation,
    skeleton: Usd.Prim,
    joints: list[str],
    moved: Array,
    turned: Array,
    scales: Array,
    codes: Array,
) -> None:
    """Write translations (frames, joints, 3), rotations (frames, joints, 4) and scales (joints, 3) at time codes
    (frames,), and bind the skeleton to the animation."""
    animation.CreateJointsAttr(joints)
    attributes = animation.CreateTranslationsAttr(), animation.CreateRotationsAttr(), animation.CreateScalesAttr()
    for attribute in attributes:
        attribute.Clear()
    attributes[2].Set(Vt.Vec3hArray.FromNumpy(np.ascontiguousarray(scales, np.float16)))
    for attribute, kind, values in ((attributes[1], Vt.QuatfArray, turned), (attributes[0], Vt.Vec3fArray, moved)):
        for value, code in zip(np.ascontiguousarray(values, np.float32), codes.tolist(), strict=True):
            attribute.Set(kind.FromNumpy(value), code)  # USD's quaternions take xyzw, as ours are
    UsdSkel.BindingAPI.Apply(skeleton).CreateAnimationSourceRel().SetTargets([animation.GetPath()])


def _as_own(stage: Usd.Stage, prim: Usd.Prim) -> Usd.Prim:
    """Return a prim that can be changed: what it shares with other instances is made its own."""
    path = prim.GetPath()
    for above in path.GetPrefixes():
        one = stage.GetPrimAtPath(above)
        if one.IsInstance():
            one.SetInstanceable(False)
    return stage.GetPrimAtPath(path)


def _set_times(stage: Usd.Stage, replaced: Usd.Prim | None, frames: int, rate: float) -> Array:
    """Set the stage's first and last time, and return the time code of every frame.

    There is one time code a frame from 0, and their rate is the motion's, unless something else in the stage moves:
    then the stage keeps its rate, so that this goes on as fast as before.
    """
    start, step = 0.0, 1.0
    if any(
        attribute.ValueMightBeTimeVarying()
        for prim in walk(stage)
        if replaced is None or prim.GetPath() != replaced.GetPath()
        for attribute in prim.GetAttributes()
    ):
        start = stage.GetStartTimeCode() if stage.HasAuthoredTimeCodeRange() else 0.0
        step = stage.GetTimeCodesPerSecond() / rate
    else:
        stage.SetTimeCodesPerSecond(rate)
        stage.SetFramesPerSecond(rate)
    codes = start + np.arange(frames) * step
    stage.SetStartTimeCode(float(codes[0]))
    stage.SetEndTimeCode(float(codes[-1]))
    return codes


def _place_roots(skeleton: SkeletonPrim, motion: NewMotion, codes: Array) -> tuple[Array, Array]:
    """Return translations (frames, joints, 3) and rotations (frames, joints, 4), with those of the roots in the
    skeleton's space as its placement is at each time."""
    moved, turned = motion.translations.copy(), motion.rotations.copy()
    if not animated_placement(skeleton.prim):
        return moved, turned
    roots = [joint for joint, parent in enumerate(skeleton.parents) if parent < 0]
    for frame, code in enumerate(codes.tolist()):
        change = np.linalg.pinv(world_of(skeleton.prim, Usd.TimeCode(code))) @ motion.outer
        turn = change[:3, :3] / np.cbrt(abs(np.linalg.det(change[:3, :3])))
        moved[frame, roots] = moved[frame, roots] @ change[:3, :3].T + change[:3, 3]
        turned[frame, roots] = (Rotation.from_matrix(turn) * Rotation.from_quat(turned[frame, roots])).as_quat()
    for frame in range(1, len(codes)):
        flipped = (turned[frame] * turned[frame - 1]).sum(-1) < 0
        turned[frame, flipped] *= -1
    return moved, turned


def _plain_name(name: str, taken: Collection[str]) -> str:
    """Return a name of letters, digits and _, as prims and joints have, that is not taken."""
    plain = re.sub(r"\W", "_", name, flags=re.ASCII) or "_"
    plain = f"_{plain}" if plain[0].isdigit() else plain
    return next(w for w in (plain, *(f"{plain}_{k}" for k in range(2, len(taken) + 3))) if w not in taken)


def _set_extent(prim: Usd.Prim, positions: Array) -> None:
    """Set the extent of the SkelRoot that a skeleton is in, if it has one; viewers draw nothing beyond it."""
    while prim and not prim.IsA(UsdSkel.Root):
        prim = prim.GetParent()
    extent = UsdGeom.Boundable(prim).GetExtentAttr() if prim else None
    if not extent or read_value(extent) is None:
        return
    corners = np.array([positions.min(axis=(0, 1)) - _MARGIN, positions.max(axis=(0, 1)) + _MARGIN])
    grid = np.array(np.meshgrid(*corners.T)).reshape(3, -1)
    back = np.linalg.pinv(world_of(prim, _FIRST))
    own = (back[:3, :3] @ grid + back[:3, 3:]).T
    extent.Clear()
    extent.Set(Vt.Vec3fArray.FromNumpy(np.array([own.min(0), own.max(0)], np.float32)))


def _build_stage(motion: "Motion") -> Usd.Stage:
    """Build a stage in memory: skeleton, animation and skinned mannequin."""
    from mapctl.formats.bvh import all_translations, as_array
    from mapctl.formats.character import build_skinned_body
    from mapctl.rotations import make_sign_continuous

    stage, rate, joints = Usd.Stage.CreateInMemory(), float(motion.fps), joint_paths(motion.skeleton)
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    codes = _set_times(stage, None, motion.num_frames, rate)
    top = UsdSkel.Root.Define(stage, _ROOT)
    stage.SetDefaultPrim(top.GetPrim())
    name, body = build_skinned_body(motion)

    skeleton = UsdSkel.Skeleton.Define(stage, f"{_ROOT}/skeleton")
    skeleton.CreateJointsAttr(joints)
    skeleton.CreateJointNamesAttr(list(motion.skeleton.names))
    offsets = motion.skeleton.offsets.numpy().copy()
    offsets[0] = 0.0
    for create, positions, frames in (
        (skeleton.CreateBindTransformsAttr, body.rest, body.frames),
        (skeleton.CreateRestTransformsAttr, offsets, None),
    ):
        matrices = np.tile(np.eye(4), (len(positions), 1, 1))
        matrices[:, 3, :3] = positions  # USD's vectors are rows, so the translation is the last row
        if frames is not None:
            matrices[:, :3, :3] = np.swapaxes(frames, 1, 2)
        create(Vt.Matrix4dArray.FromNumpy(matrices))

    animation, turned = UsdSkel.Animation.Define(stage, f"{_ROOT}/motion"), make_sign_continuous(motion.local_quat_xyzw)
    moved, scales = all_translations(motion), np.ones((len(joints), 3))
    _write_animation(animation, skeleton.GetPrim(), joints, moved, as_array(turned), scales, codes)

    UsdSkel.BindingAPI.Apply(_define_mesh(stage, name, body)).CreateSkeletonRel().SetTargets([skeleton.GetPath()])
    top.CreateExtentAttr([Gf.Vec3f(0.0)] * 2)
    _set_extent(top.GetPrim(), motion.joint_positions().numpy())
    if motion.licence:
        stage.GetRootLayer().customLayerData = {"licence": motion.licence}
    return stage


def joint_paths(skeleton: "Skeleton") -> list[str]:
    """Return each joint's USD path: the names from the root on, of letters, digits and _, unique among siblings."""
    found: list[str] = []
    for name, parent in zip(skeleton.names, skeleton.parents, strict=True):
        above = f"{found[parent]}/" if parent >= 0 else ""
        taken = {path.removeprefix(above) for path in found if path.startswith(above)}
        found.append(above + _plain_name(name, taken))
    return found


def _define_mesh(stage: Usd.Stage, name: str, body: "CharacterMesh") -> Usd.Prim:
    mesh = UsdGeom.Mesh.Define(stage, f"{_ROOT}/{name}")
    mesh.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(body.vertices.astype(np.float32)))
    mesh.CreateFaceVertexCountsAttr(Vt.IntArray.FromNumpy(np.full(len(body.faces), 3, np.int32)))
    mesh.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(body.faces.reshape(-1).astype(np.int32)))
    mesh.CreateNormalsAttr(Vt.Vec3fArray.FromNumpy(body.normals.astype(np.float32)))
    mesh.SetNormalsInterpolation(UsdGeom.Tokens.vertex)
    mesh.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    mesh.CreateExtentAttr([Gf.Vec3f(*corner.tolist()) for corner in (body.vertices.min(0), body.vertices.max(0))])
    colour = mesh.CreateDisplayColorPrimvar(UsdGeom.Tokens.vertex)
    colour.Set(Vt.Vec3fArray.FromNumpy(parts.decode_srgb(body.rgba[:, :3]).astype(np.float32)))
    binding, width = UsdSkel.BindingAPI.Apply(mesh.GetPrim()), body.joints.shape[1]
    joints, weights = body.joints.reshape(-1).astype(np.int32), body.weights.reshape(-1).astype(np.float32)
    binding.CreateJointIndicesPrimvar(False, width).Set(Vt.IntArray.FromNumpy(joints))
    binding.CreateJointWeightsPrimvar(False, width).Set(Vt.FloatArray.FromNumpy(weights))
    binding.CreateGeomBindTransformAttr(Gf.Matrix4d(1.0))
    return mesh.GetPrim()


def _export(stage: Usd.Stage, scratch: Path) -> None:
    """Export the stage; OSError where it cannot be written: USD's own error has many lines, the reason among them."""
    try:
        written = stage.GetRootLayer().Export(str(scratch))
    except RuntimeError as error:
        found = _WRITE_FAULT.search(str(error))
        reason = found[1] if found else "USD cannot write there"
        number = next((number for number in (errno.ENOSPC, errno.EDQUOT) if os.strerror(number) == reason), None)
        raise OSError(number, reason) from error
    if not written:
        raise OSError("USD gives no reason")
