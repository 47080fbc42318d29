"""Between a rig's own joint frames and the canonical ones, both ways and without loss.

In the T-pose every canonical joint frame is aligned with the world. A rig's joint j then has some world rotation B_j,
and at any time: canonical world rotation = rig's world rotation * inverse(B_j). The canonical motion keeps the
performer's own bone lengths; only the frames change.
"""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from mapctl import kinematics, rotations
from mapctl.errors import RequestError
from mapctl.motion import Motion
from mapctl.rigs import Rig, recognise
from mapctl.skeleton import CANONICAL, Skeleton


@dataclass(frozen=True, eq=False)
class RigMap:
    """How one skeleton of a rig maps to canonical joints."""

    rig: Rig
    """The rig's names and T-pose."""
    rig_skeleton: Skeleton
    """The rig's own skeleton."""
    joint_of: tuple[int | None, ...]
    """For each canonical joint the rig's joint, None where the rig has only an End Site."""
    tpose_quat_xyzw: Float[Tensor, "joints 4"]
    """B: world rotation of each canonical joint's rig joint in the T-pose."""
    skeleton: Skeleton
    """Canonical names and tree with this performer's bones."""


def map_rig(skeleton: Skeleton) -> RigMap:
    """Recognise the rig and measure its bones; RequestError if no known rig fits."""
    rig = recognise(skeleton)
    joint_of = tuple(skeleton.index(rig.joints[name]) if name in rig.joints else None for name in CANONICAL.names)
    tpose = _tpose(rig, skeleton, joint_of)
    bones, ends = _bones(skeleton, joint_of, tpose)
    return RigMap(rig, skeleton, joint_of, tpose, Skeleton(CANONICAL.names, CANONICAL.parents, bones, ends))


def to_canonical(motion: Motion) -> tuple[Motion, RigMap]:
    """The motion in canonical joint frames with the performer's own bones, and the map that leads back."""
    rigmap = map_rig(motion.skeleton)
    world = motion.joint_rotations()
    picked = []
    for name, joint, tpose in zip(CANONICAL.names, rigmap.joint_of, rigmap.tpose_quat_xyzw, strict=True):
        if joint is None:  # an End Site turns with its parent
            picked.append(picked[CANONICAL.parents[CANONICAL.index(name)]])
        else:
            picked.append(rotations.multiply(world[:, joint], rotations.inverse(tpose).expand(len(world), 4)))
    local = kinematics.local_from_world(CANONICAL.parents, torch.stack(picked, dim=1))
    hips = motion.joint_positions()[:, _hips(rigmap)]
    return Motion(rigmap.skeleton, motion.fps, hips, rotations.sign_continuous(local)), rigmap


def from_canonical(motion: Motion, rigmap: RigMap, original: Motion | None = None) -> Motion:
    """The canonical motion on the rig. Joints the canonical skeleton lacks keep the original's rotation.

    Without an original of the same length they rest (fingers straight). The result carries the original's file layout.
    """
    skeleton, frames = rigmap.rig_skeleton, motion.num_frames
    kept = original is not None and original.num_frames == frames
    rest = torch.tensor([0.0, 0.0, 0.0, 1.0], dtype=torch.float64).expand(frames, skeleton.num_joints, 4)
    own = original.local_quat_xyzw if original is not None and kept else rest
    wanted = _wanted_world(motion, rigmap)
    local, world = [], []
    for joint, parent in enumerate(skeleton.parents):
        above = world[parent] if parent >= 0 else None
        turn = own[:, joint] if joint not in wanted else wanted[joint]
        if joint in wanted and above is not None:
            turn = rotations.multiply(rotations.inverse(above), wanted[joint])
        local.append(turn)
        world.append(turn if above is None else rotations.multiply(above, turn))
    on_rig = Motion(skeleton, motion.fps, rest[:, 0, :3].clone(), rotations.sign_continuous(torch.stack(local, 1)),
                    source=original.source if original is not None else None)  # fmt: skip
    return _place_hips(on_rig, rigmap, motion.root_position, original if kept else None)


def _wanted_world(motion: Motion, rigmap: RigMap) -> dict[int, Tensor]:
    world = motion.joint_rotations()
    pairs = enumerate(zip(rigmap.joint_of, rigmap.tpose_quat_xyzw, strict=True))
    return {j: rotations.multiply(world[:, c], b.expand(len(world), 4)) for c, (j, b) in pairs if j is not None}


def _place_hips(on_rig: Motion, rigmap: RigMap, hips: Tensor, original: Motion | None) -> Motion:
    """Put the hips where they belong: by the root itself, or by its animated offset below a static root."""
    joint = _hips(rigmap)
    if joint == 0:
        moving = original.moving_offsets if original is not None else {}
        return replace(on_rig, root_position=hips, moving_offsets=moving)
    if original is not None:
        on_rig = replace(on_rig, root_position=original.root_position, moving_offsets=original.moving_offsets)
    parent = on_rig.skeleton.parents[joint]
    turn, place = on_rig.joint_rotations()[:, parent], on_rig.joint_positions()[:, parent]
    offset = rotations.rotate(rotations.inverse(turn), hips - place)
    return replace(on_rig, moving_offsets={**on_rig.moving_offsets, joint: offset})


def _hips(rigmap: RigMap) -> int:
    joint = rigmap.joint_of[0]
    if joint is None:
        raise RequestError(f"the rig {rigmap.rig.name} names no hips")
    return joint


def _tpose(rig: Rig, skeleton: Skeleton, joint_of: tuple[int | None, ...]) -> Tensor:
    quats = []
    for index, name in enumerate(CANONICAL.names):
        axes = rig.tpose.get(name)
        matrix = _frame(axes["x"], axes["y"]) if axes else torch.eye(3, dtype=torch.float64)
        if name in rig.straighten:
            matrix = _straightened(index, skeleton, joint_of)
        quats.append(rotations.from_matrix(matrix))
    return torch.stack(quats)


def _frame(x: list[float], y: list[float]) -> Tensor:
    """Rotation whose first two columns point along x and (as nearly as they are square) y."""
    first = torch.nn.functional.normalize(torch.tensor(x, dtype=torch.float64), dim=0)
    second = torch.tensor(y, dtype=torch.float64)
    second = torch.nn.functional.normalize(second - first * (first @ second), dim=0)
    return torch.stack([first, second, torch.linalg.cross(first, second)], dim=1)


def _straightened(index: int, skeleton: Skeleton, joint_of: tuple[int | None, ...]) -> Tensor:
    """The smallest rotation that lays the joint's bone along its canonical direction."""
    child = CANONICAL.children(index)[0]
    rig_child = joint_of[child]
    if rig_child is None:
        raise RequestError(f"cannot straighten {CANONICAL.names[index]}: the rig has no joint after it")
    bone = torch.nn.functional.normalize(skeleton.offsets[rig_child], dim=0)
    aim = torch.nn.functional.normalize(CANONICAL.offsets[child], dim=0)
    return _shortest_turn(bone, aim)


def _shortest_turn(start: Float[Tensor, "3"], stop: Float[Tensor, "3"]) -> Float[Tensor, "3 3"]:
    """The smallest rotation from one unit vector to another; of opposite ones, one of the half turns."""
    axis, cosine = torch.linalg.cross(start, stop), start @ stop
    if cosine < 0 and axis.norm() < 1e-9:
        across = torch.nn.functional.one_hot(start.abs().argmin(), 3).to(start.dtype)
        axis = torch.linalg.cross(start, across)
        return rotations.rotation_vector_to_matrix(axis / axis.norm() * torch.pi)
    sine = axis.norm().clamp_min(1e-12)
    return rotations.rotation_vector_to_matrix(axis / sine * torch.atan2(sine, cosine))


def _bones(skeleton: Skeleton, joint_of: tuple[int | None, ...], tpose: Tensor):
    """Canonical offsets (21, 3) and end offsets of this performer: the rig put into its T-pose, joint by joint."""
    canonical_of = {joint: c for c, joint in enumerate(joint_of) if joint is not None}
    place, turn = [torch.zeros(3, dtype=torch.float64)], []
    for joint, parent in enumerate(skeleton.parents):
        if parent >= 0:
            place.append(place[parent] + rotations.rotate(turn[parent], skeleton.offsets[joint]))
        if joint in canonical_of:
            turn.append(tpose[canonical_of[joint]])
        else:
            turn.append(turn[parent] if parent >= 0 else torch.tensor([0.0, 0, 0, 1], dtype=torch.float64))

    def end_of(joint: int) -> Tensor:
        site = torch.tensor(skeleton.end_offsets.get(skeleton.names[joint], (0.0, 0.0, 0.0)), dtype=torch.float64)
        return rotations.rotate(turn[joint], site)

    def spot_of(canonical: int) -> Tensor:
        joint, above = joint_of[canonical], joint_of[CANONICAL.parents[canonical]]
        if joint is not None:
            return place[joint]
        if above is None:
            raise RequestError(f"the rig has neither {CANONICAL.names[canonical]} nor the joint above it")
        return place[above] + end_of(above)

    spots = torch.stack([spot_of(c) for c in range(CANONICAL.num_joints)])
    offsets = torch.cat([torch.zeros(1, 3, dtype=torch.float64), spots[1:] - spots[list(CANONICAL.parents[1:])]])
    ends = {CANONICAL.names[c]: tuple(end_of(j).tolist()) for c, j in enumerate(joint_of)
            if j is not None and skeleton.names[j] in skeleton.end_offsets and not CANONICAL.children(c)}  # fmt: skip
    return offsets, ends
