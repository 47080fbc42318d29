"""Animations of a USD skeleton, read at the times of their samples."""

# pyright: reportAttributeAccessIssue=false

from dataclasses import dataclass

import numpy as np
from pxr import Usd, UsdGeom, UsdSkel

from mapctl.isolated.child import Refusal, check_extent
from mapctl.isolated.naming import find_name, make_unique
from mapctl.isolated.usd.skeletons import SkeletonPrim, read_value, walk, world_of

Array = np.ndarray


@dataclass(frozen=True, eq=False)
class Animation:
    """Poses of a skeleton at the times at which any of its samples lies."""

    name: str
    """Name by which it is chosen."""
    seconds: Array
    """(keys,) times of the samples, from time code 0 on."""
    local: Array
    """(keys, joints, 10) in the parents' frames: translation, rotation xyzw, scale."""
    outer: Array
    """(keys or 1, 4, 4) what takes the skeleton's space to the world."""


def name_animations(stage: Usd.Stage, skeleton: SkeletonPrim) -> tuple[list[str], list[Usd.Prim], bool]:
    """Return the animations that fit a skeleton, with unique names, and whether the first is bound to it."""
    bound = UsdSkel.BindingAPI(skeleton.prim).GetInheritedAnimationSource()
    own = set(skeleton.joints)
    found = [bound] if bound and bound.IsA(UsdSkel.Animation) else []
    for prim in walk(stage):
        if prim.IsA(UsdSkel.Animation) and prim not in found and _animated_joints(prim) & own:
            found.append(prim)
    return make_unique([prim.GetName() for prim in found]), found, bool(bound and found[:1] == [bound])


def read_animation(stage: Usd.Stage, skeleton: SkeletonPrim, wanted: str | None, most_poses: int) -> Animation | None:
    """Read the wanted animation, or the one that is bound to the skeleton; None where none is."""
    names, prims, bound = name_animations(stage, skeleton)
    if wanted is None and not bound:
        return None
    try:
        number = find_name("", names, wanted, "animation", several=True)
    except LookupError as error:
        raise Refusal(error.args[0]) from None
    return _sample(stage, skeleton, prims[number], names[number], most_poses)


def time_animations(stage: Usd.Stage, skeleton: SkeletonPrim) -> dict[str, float]:
    """Return the seconds that each animation of a skeleton lasts, by name."""
    names, prims, _ = name_animations(stage, skeleton)
    spans = [[code for attribute in _attributes_of(prim) for code in attribute.GetTimeSamples()] for prim in prims]
    per_second = stage.GetTimeCodesPerSecond() or 1.0
    return {
        name: (max(codes, default=0.0) - min(codes, default=0.0)) / per_second
        for name, codes in zip(names, spans, strict=True)
    }


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


def _sample(stage: Usd.Stage, skeleton: SkeletonPrim, prim: Usd.Prim, name: str, most_poses: int) -> Animation:
    animation, attributes, what = UsdSkel.Animation(prim), _attributes_of(prim), f"animation {name!r}"
    codes = {code for attribute in attributes for code in attribute.GetTimeSamples()}
    placed = animated_placement(skeleton.prim)
    per_second = stage.GetTimeCodesPerSecond()
    if not (np.isfinite(per_second) and 1e-3 <= per_second <= 1e6):
        raise Refusal(f"timeCodesPerSecond is {per_second:g}")
    codes |= set(placed)
    if codes and not np.isfinite(sum(codes)):
        raise Refusal(f"{what} has times that are not finite")
    check_extent(len(codes), len(skeleton.joints), most_poses)
    if placed:
        span = range(int(np.ceil(min(codes))), int(min(np.floor(max(codes)), min(codes) + most_poses)) + 1)
        check_extent(len(span), len(skeleton.joints), most_poses)
        codes |= {float(code) for code in span}
    times = np.array(sorted(codes) or [0.0])
    local = _sample_joints(skeleton, animation, attributes, times, what)
    outer = [world_of(skeleton.prim, Usd.TimeCode(time)) for time in (times.tolist() if placed else times[:1].tolist())]
    return Animation(name, times / per_second, local, np.array(outer))


def _sample_joints(
    skeleton: SkeletonPrim, animation: UsdSkel.Animation, attributes: list[Usd.Attribute], times: Array, what: str
) -> Array:
    """Return the skeleton's joints (keys, joints, 10); those that the animation leaves out are at rest."""
    moved = [str(joint) for joint in read_value(animation.GetJointsAttr()) or ()]
    place = {joint: number for number, joint in enumerate(skeleton.joints)}
    here = [number for number, joint in enumerate(moved) if joint in place]
    there = [place[moved[number]] for number in here]
    if not here:
        raise Refusal(f"{what} moves none of the skeleton's joints")
    local = np.tile(rest_parts(skeleton), (len(times), 1, 1))
    for attribute, columns in zip(attributes, (slice(0, 3), slice(3, 7), slice(7, 10)), strict=True):
        varies = len(attribute.GetTimeSamples()) > 1
        for key, time in enumerate(times.tolist() if varies else times[:1].tolist()):
            table = _read_table(attribute, time, len(moved), what)
            if table is not None:
                local[key if varies else slice(None), there, columns] = table[here]
    return local


def _read_table(attribute: Usd.Attribute, time: float, count: int, what: str) -> Array | None:
    """Return the values of all animated joints at a time; None where there are none."""
    value = read_value(attribute, Usd.TimeCode(time))
    if value is None or not len(value):
        return None
    if len(value) != count:
        raise Refusal(f"{what} has {count} joints and {len(value)} {attribute.GetName()}")
    return np.array(value, np.float64).reshape(count, -1)


def rest_parts(skeleton: SkeletonPrim) -> Array:
    """Return translation, rotation xyzw and scale (joints, 10) of the pose of joints that nothing moves: that which the
    skeleton says, else the one in which skins are bound."""
    matrices = skeleton.rest
    if matrices is None:
        assert skeleton.bind is not None
        above = [np.eye(4) if parent < 0 else skeleton.bind[parent] for parent in skeleton.parents]
        matrices = np.linalg.pinv(np.array(above)) @ skeleton.bind
    scales = np.linalg.norm(matrices[:, :3, :3], axis=1)
    scales *= np.where(np.linalg.det(matrices[:, :3, :3]) < 0, -1.0, 1.0)[:, None]
    turns = matrices[:, :3, :3] / np.where(abs(scales) > 1e-12, scales, 1.0)[:, None, :]
    return np.concatenate([matrices[:, :3, 3], to_quaternions(turns), scales], axis=1)


def to_quaternions(turns: Array) -> Array:
    """Return quaternions xyzw (n, 4) of rotations (n, 3, 3): eigenvectors of the greatest eigenvalue of a symmetric
    matrix that is built of them (Bar-Itzhack, 2000), which also serves for matrices that are nearly rotations."""
    (a, b, c), (d, e, f), (g, h, i) = (turns[:, k].T for k in range(3))
    rows = [[a - e - i, b + d, c + g, h - f], [b + d, e - a - i, f + h, c - g]]
    rows += [[c + g, f + h, i - a - e, d - b], [h - f, c - g, d - b, a + e + i]]
    symmetric = np.array(rows).transpose(2, 0, 1)
    return np.linalg.eigh(symmetric)[1][:, :, -1]
