"""Animations of an FBX file (its takes, or stacks), read at the frames of the file's rate."""

from dataclasses import dataclass

import numpy as np
import ufbx

from mapctl.isolated.child import Refusal, check_extent
from mapctl.isolated.fbx.armatures import Armature
from mapctl.isolated.fbx.scene import line_of
from mapctl.isolated.naming import find_name, make_unique

Array = np.ndarray
_USUAL_RATE = 30.0
_EARLY_SHARE = 0.02  # of a frame by which a take may end before it


@dataclass(frozen=True, eq=False)
class Take:
    """Poses of an armature at the frames of one rate."""

    name: str
    """Name of the animation."""
    rate: float
    """Frames per second, as the file says."""
    local: Array
    """(frames, joints, 10) of each joint in its parent's frame: translation, rotation xyzw, scale."""
    above: Array
    """(frames or 1, nodes above the root, 10) likewise, the outermost first."""


def time_takes(scene: ufbx.Scene, armature: Armature) -> dict[str, float]:
    """Return the seconds that each animation lasts that moves the armature, by name."""
    own = _own_elements(armature)
    spans = {name: _find_range(stack, own) for name, stack in _name_takes(scene).items() if _moved_nodes(stack) & own}
    return {name: end - begin for name, (begin, end) in spans.items()}


def read_take(scene: ufbx.Scene, armature: Armature, wanted: str | None, most_poses: int) -> Take | None:
    """Read the wanted animation, or the first that moves the armature; None where none does."""
    takes, own = _name_takes(scene), _own_elements(armature)
    if wanted is not None:
        try:
            find_name("", list(takes), wanted, "animation", several=True)
        except LookupError as error:
            raise Refusal(error.args[0]) from None
        if not _moved_nodes(takes[wanted]) & own:
            raise Refusal(f"animation {wanted!r} does not move {armature.name!r}")
        return _sample(scene, takes[wanted], wanted, armature, most_poses)
    for name, stack in takes.items():
        if _moved_nodes(stack) & own:
            return _sample(scene, stack, name, armature, most_poses)
    return None


def _name_takes(scene: ufbx.Scene) -> dict[str, ufbx.AnimStack]:
    stacks = list(scene.anim_stacks)
    return dict(zip(make_unique([stack.name or f"take_{k}" for k, stack in enumerate(stacks)]), stacks, strict=True))


def _own_elements(armature: Armature) -> set[int]:
    """Return the elements of an armature's nodes and of all above them."""
    return {node.element_id for node in [*armature.nodes, *line_of(armature.nodes[0])]}


def _moved_nodes(stack: ufbx.AnimStack) -> set[int]:
    """Return the elements whose transforms the animation moves."""
    moved = ("Lcl Translation", "Lcl Rotation", "Lcl Scaling")
    return {
        prop.element.element_id
        for layer in stack.layers
        for prop in layer.anim_props
        if prop.prop_name in moved or "Pivot" in prop.prop_name or "Offset" in prop.prop_name
    }


def _sample(scene: ufbx.Scene, stack: ufbx.AnimStack, name: str, armature: Armature, most_poses: int) -> Take:
    outer = line_of(armature.nodes[0])[:0:-1]
    rate = scene.settings.frames_per_second
    rate = rate if np.isfinite(rate) and 0.01 <= rate <= 1e5 else _USUAL_RATE
    begin, end = _find_range(stack, _own_elements(armature))
    if not (np.isfinite(begin) and np.isfinite(end)) or end < begin:
        raise Refusal(f"animation {name!r} lasts from {begin:g} to {end:g} s")
    count = np.floor((end - begin) * rate + _EARLY_SHARE) + 1
    check_extent(int(min(count, 1e15)), len(armature.nodes) + len(outer), most_poses)
    times = begin + np.arange(int(count)) / rate
    moved = _moved_nodes(stack)
    anim = stack.anim
    local = np.stack([_sample_node(anim, node, times, moved) for node in armature.nodes], axis=1)
    above = np.zeros((1, 0, 10))
    if outer:
        above = np.stack([_sample_node(anim, node, times, moved) for node in outer], axis=1)
    return Take(name, rate, local, above if {node.element_id for node in outer} & moved else above[:1])


def _find_range(stack: ufbx.AnimStack, own: set[int]) -> tuple[float, float]:
    """Return the first and last second that the animation says, else those of the keys of these elements."""
    if stack.time_end > stack.time_begin:
        return stack.time_begin, stack.time_end
    curves = [
        curve
        for layer in stack.layers
        for prop in layer.anim_props
        if prop.element.element_id in own
        for curve in prop.anim_value.curves
        if curve is not None and len(curve.keyframes)
    ]
    times = [time for curve in curves for time in (curve.min_time, curve.max_time)]
    return min(times, default=0.0), max(times, default=0.0)


def _sample_node(anim: ufbx.Anim, node: ufbx.Node, times: Array, moved: set[int]) -> Array:
    if node.is_root:
        return np.tile(transform_of(node.local_transform), (len(times), 1))
    if node.element_id not in moved:
        return np.tile(transform_of(ufbx.evaluate_transform(anim, node, float(times[0]))), (len(times), 1))
    return np.array([transform_of(ufbx.evaluate_transform(anim, node, time)) for time in times.tolist()])


def transform_of(transform: ufbx.Transform) -> tuple[float, ...]:
    """Return translation, rotation xyzw and scale as ten numbers."""
    return (*transform.translation, *transform.rotation, *transform.scale)
