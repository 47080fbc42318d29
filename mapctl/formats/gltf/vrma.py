"""VRM animations out: the bones of a humanoid and their motion alone, at rest a T-pose that faces +Z.

Follows VRMC_vrm_animation 1.0: only the hips travel, no node is scaled, and eyes are none of the bones.
"""

from collections.abc import Mapping
from os import PathLike

import torch

from mapctl import kinematics, rotations
from mapctl.errors import RequestError
from mapctl.formats.atomic import write_bytes
from mapctl.formats.characters.source import CharacterSource
from mapctl.formats.gltf import mannequin
from mapctl.formats.gltf.container import read_file
from mapctl.formats.gltf.vrm import read_bones
from mapctl.formats.text import warn_once
from mapctl.motion import Motion
from mapctl.skeleton import CANONICAL, Skeleton

_THUMBS = {"ThumbProximal": "ThumbMetacarpal", "ThumbIntermediate": "ThumbProximal"}
"""Bones of VRM 0 that have another name in VRM 1."""
_HALF_TURN = torch.tensor([0.0, 1.0, 0.0, 0.0], dtype=torch.float64)
_STILL_METRES = 1e-3


def save(motion: Motion, path: str | PathLike[str]) -> None:
    """Write the motion of a VRM character's bones, or of the canonical joints. RequestError for other motions."""
    bones = _find_bones(motion)
    if "hips" not in bones:
        needed = "needs the motion of a VRM or of canonical joints; `mapctl convert` makes one of any other file"
        raise RequestError(f"cannot write {path}: a .vrma {needed}")
    body, hips = _select_bones(motion, bones, path)
    of_joint = {joint: bone for bone, joint in bones.items()}
    order = {of_joint[motion.skeleton.index(name)]: node for node, name in enumerate(body.skeleton.names)}
    write_bytes(path, mannequin.to_bytes(body, path=path, bones=order, root_at_rest=hips))


def _find_bones(motion: Motion) -> dict[str, int]:
    """Return the joint of each bone, by VRM 1's name; empty where nothing says which is which."""
    source = motion.source
    if not isinstance(source, CharacterSource) or not source.humanoid or not source.holds(motion):
        return {name: j for j, name in enumerate(CANONICAL.names)} if motion.skeleton.names == CANONICAL.names else {}
    source.check_unchanged()
    bones = read_bones(read_file(source.path))
    renamed = _THUMBS if "leftThumbIntermediate" in bones or "rightThumbIntermediate" in bones else {}
    named = {next((b.replace(old, new) for old, new in renamed.items() if old in b), b): n for b, n in bones.items()}
    joints = {node: joint for joint, node in enumerate(source.nodes)}
    return {bone: joints[node] for bone, node in named.items() if node in joints and not bone.endswith("Eye")}


def _select_bones(motion: Motion, bones: Mapping[str, int], path: str | PathLike[str]) -> tuple[Motion, list[float]]:
    """Return the motion of the bones alone, the hips first, and where these are at rest in the world."""
    whole = motion.skeleton
    rest = whole.offsets.clone()
    for joint, parent in enumerate(whole.parents[1:], start=1):
        rest[joint] += rest[parent]
    hips = bones["hips"]
    joints = [hips, *sorted(set(bones.values()) - {hips})]
    parents = [-1, *(_nearest_above(whole, joint, joints) for joint in joints[1:])]
    ends = {name: end for name, end in whole.end_offsets.items() if whole.index(name) in joints}
    if isinstance(motion.source, CharacterSource):
        height = torch.from_numpy(motion.source.frames.positions[hips].copy())
    else:
        tips = [rest[whole.index(name)] + torch.tensor(end, dtype=rest.dtype) for name, end in ends.items()]
        height = torch.tensor([0.0, float(rest[hips, 1] - torch.stack([*rest, *tips])[:, 1].min()), 0.0])
    offsets = torch.stack([rest[j] - rest[joints[max(p, 0)]] for j, p in zip(joints, parents, strict=True)])
    world, places = motion.joint_rotations()[:, joints], motion.joint_positions()[:, joints]
    if rest[bones["leftUpperLeg"], 0] < rest[bones["rightUpperLeg"], 0]:  # VRM 0 faces -Z
        flip = torch.tensor([-1.0, 1.0, -1.0], dtype=torch.float64)
        offsets, places, height = offsets * flip, places * flip, height * flip
        ends = {name: (-x, y, -z) for name, (x, y, z) in ends.items()}
        turn = _HALF_TURN.expand_as(world)
        world = rotations.multiply(rotations.multiply(turn, world), rotations.inverse(turn))
    local = rotations.make_sign_continuous(kinematics.local_from_world(tuple(parents), world))
    skeleton = Skeleton(tuple(whole.names[joint] for joint in joints), tuple(parents), offsets, ends)
    body = Motion(skeleton, motion.fps, places[:, 0].clone(), local, licence=motion.licence)
    lost = float((body.joint_positions() - places).norm(dim=-1).max())
    if lost > _STILL_METRES:
        warn_once(
            f"{path}: only the hips of a .vrma travel; bones whose length changes are up to {100 * lost:.1f} cm off"
        )
    return body, height.tolist()


def _nearest_above(skeleton: Skeleton, joint: int, joints: list[int]) -> int:
    """Return the place among `joints` of the nearest of them above a joint; the first, the hips, where none is."""
    above = skeleton.parents[joint]
    while above >= 0 and above not in joints:
        above = skeleton.parents[above]
    return joints.index(above) if above >= 0 else 0
