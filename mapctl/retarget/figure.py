"""Clips of standing still: of a character in its rest pose, and of a rig of which only names and T-pose are known."""

from dataclasses import replace
from fractions import Fraction
from os import PathLike

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from mapctl import formats, retarget, rotations
from mapctl.errors import MapctlError, RequestError
from mapctl.formats.bvh import layout as bvh_layout
from mapctl.motion import Motion
from mapctl.retarget.joint_matching import REQUIRED
from mapctl.retarget.reference_pose import axis_vector, frame_from_axes, upright_rotation
from mapctl.retarget.rig_poses import RigPoses
from mapctl.retarget.rigs import Rig
from mapctl.retarget.stance import SIDES
from mapctl.retarget.topology import descendants
from mapctl.skeleton import CANONICAL, TOE_JOINTS, TOE_REST_HEIGHT, Skeleton

_FPS, _FRAMES = Fraction(30), 30


def make_tpose_clip(rig: Rig) -> Motion:
    """Make a second of standing in the T-pose on the rig's joints, in its world and unit; toes on the floor.

    Bones are the canonical body's, since a rig has names and no lengths. RequestError where it lacks one of the names
    that are required.
    """
    missing = [name for name in REQUIRED if name not in rig.joints]
    if missing:
        raise RequestError(
            f"rig {rig.name} names no joint for {', '.join(missing)}: a skeleton cannot be made of it; "
            "name them, or a clip"
        )
    skeleton = _build_skeleton(rig)
    standing = retarget.from_canonical(_canonical_tpose(), retarget.identify_rig(skeleton, rig))
    if rig.metres_per_unit is None:
        return standing
    layout = bvh_layout.choose_layout(standing, rig.name)
    return replace(standing, source=replace(layout, metres_per_unit=rig.metres_per_unit))


def load_standing_character(path: str | PathLike[str]) -> Motion | None:
    """Load a second of a character's standing in the rest pose of its file, its soles on the floor; None for files that
    have no rest pose of their own.

    Soles are the lowest vertices that feet carry; where the file has no triangles, the floor is where it has it.
    """
    rest = formats.load_rest(path)
    if rest is None:
        return None
    down = torch.tensor([0.0, _sole_height(rest, path), 0.0], dtype=torch.float64)
    frames = torch.zeros(_FRAMES, dtype=torch.long)
    return replace(
        rest,
        fps=_FPS,
        root_position=(rest.root_position - down)[frames],
        local_quat_xyzw=rest.local_quat_xyzw[frames],
        moving_offsets={joint: track[frames] for joint, track in rest.moving_offsets.items()},
    )


def _sole_height(rest: Motion, path: str | PathLike[str]) -> float:
    """Return the height of the lowest vertex that a foot, toes or what is below them carry, metres."""
    try:
        mesh = formats.load_mesh(path)
        rigmap = retarget.identify_rig(rest.skeleton, motion=rest)
    except MapctlError:  # without triangles or a known rig there are no soles
        return 0.0
    below = descendants(rest.skeleton, [rigmap.joints[side + "Foot"] for side in SIDES])
    main = np.take_along_axis(mesh.joints, mesh.weights.argmax(axis=1)[:, None], axis=1)[:, 0]
    heights = mesh.vertices[np.isin(main, sorted(below)), 1]
    return float(heights.min()) if len(heights) else 0.0


def _canonical_tpose() -> Motion:
    root = torch.zeros(_FRAMES, 3, dtype=torch.float64)
    root[:, 1] = TOE_REST_HEIGHT - RigPoses.zero(CANONICAL).positions[0, TOE_JOINTS[0], 1]
    still = torch.tensor([0.0, 0.0, 0.0, 1.0], dtype=torch.float64)
    return Motion(CANONICAL, _FPS, root, still.expand(_FRAMES, CANONICAL.num_joints, 4).clone())


def _build_skeleton(rig: Rig) -> Skeleton:
    """Build the joints that the rig names, depth first, as files nest them."""
    order = [joint for joint in _depth_first(0) if CANONICAL.names[joint] in rig.joints]
    places = dict(enumerate(RigPoses.zero(CANONICAL).positions[0]))
    frames = {joint: _joint_frame(rig, CANONICAL.names[joint]) for joint in order}
    above = {joint: _named_ancestor(joint, rig) for joint in order}
    own = {joint: rig.joints[CANONICAL.names[joint]] for joint in order}
    spine, chest = CANONICAL.index("spine"), CANONICAL.index("chest")
    if above.get(chest) == spine:
        between = range(CANONICAL.num_joints, CANONICAL.num_joints + len(rig.trunk))
        for number, joint in enumerate(between, start=1):
            own[joint], above[joint], frames[joint] = rig.trunk[number - 1], above[chest], frames[spine]
            places[joint] = torch.lerp(places[spine], places[chest], number / (len(between) + 1))
            order.insert(order.index(chest), joint)
            above[chest] = joint
    offsets = [places[0] if (p := above[j]) is None else frames[p].T @ (places[j] - places[p]) for j in order]
    ends: dict[str, Tensor] = {}
    for joint, name in own.items():
        below = CANONICAL.children(joint) if joint < CANONICAL.num_joints else [chest]
        if not below:
            ends[name] = frames[joint].T @ torch.tensor(CANONICAL.end_offsets[CANONICAL.names[joint]]).double()
        elif all(CANONICAL.names[child] not in rig.joints for child in below):
            ends[name] = frames[joint].T @ (places[below[0]] - places[joint])
    parents = tuple(-1 if (p := above[joint]) is None else order.index(p) for joint in order)
    tips = {name: (float(x), float(y), float(z)) for name, (x, y, z) in ends.items()}
    return Skeleton(tuple(own[joint] for joint in order), parents, torch.stack(offsets), tips)


def _depth_first(joint: int) -> list[int]:
    return [joint, *(below for child in CANONICAL.children(joint) for below in _depth_first(child))]


def _named_ancestor(joint: int, rig: Rig) -> int | None:
    """Return the nearest canonical joint above that the rig names."""
    parent = CANONICAL.parents[joint]
    while parent >= 0 and CANONICAL.names[parent] not in rig.joints:
        parent = CANONICAL.parents[parent]
    return None if parent < 0 else parent


def _joint_frame(rig: Rig, name: str) -> Float[Tensor, "3 3"]:
    """Return the rotation of a joint's frame in the T-pose, with Y up: by the table, or by the file's axes."""
    axes = rig.tpose.get(name)
    if axes:
        return frame_from_axes(axes["x"], axes["y"])
    if rig.tpose:
        return torch.eye(3, dtype=torch.float64)
    return _file_to_world(rig)


def _file_to_world(rig: Rig) -> Float[Tensor, "3 3"]:
    up = axis_vector("y" if rig.up == "auto" else rig.up)
    upright = upright_rotation(rig.up) if rig.up not in ("auto", "y") else None
    front = axis_vector("z") if upright is None else rotations.rotate(rotations.inverse(upright), axis_vector("z"))
    if rig.facing != "auto" and abs(float(axis_vector(rig.facing) @ up)) < 0.5:
        front = axis_vector(rig.facing)
    return torch.stack([torch.linalg.cross(up, front), up, front])
