"""Keyframes of in-betweening: what they leave missing, their effector targets, and the errors of a motion at them."""

from collections.abc import Sequence
from typing import Any

import torch

from mapctl import rotations
from mapctl.errors import RequestError
from mapctl.inbetweening.effector_targets import EffectorTargets
from mapctl.inbetweening.missing import MissingMask
from mapctl.intent.keyframes import Key, Keys
from mapctl.joint_names import classify_joint, describe_nearest, find_joint
from mapctl.motion import Motion
from mapctl.retarget import RigMap, identify_rig, rig_joint_positions
from mapctl.retarget.rigs import Rig
from mapctl.skeleton import CANONICAL, LIMBS


def missing_between_keys(keys: Sequence[Key], motion: Motion, rigmap: RigMap) -> MissingMask:
    """Return the mask of all values of a motion that keys do not give."""
    free = torch.ones(motion.num_frames, dtype=torch.bool)
    free[[key.frame for key in keys if key.what == "pose"]] = False
    joints, root = free[:, None].expand(-1, motion.num_joints).clone(), free.clone()
    carries_hips = torch.tensor([_carries_hips(joint, rigmap) for joint in range(motion.num_joints)])
    for key in keys:
        if key.what == "root":
            root[key.frame] = False
            joints[key.frame] = ~carries_hips
    return MissingMask(joints, root)


def collect_effector_targets(keys: Sequence[Key], motion: Motion, rigmap: RigMap) -> EffectorTargets | None:
    """Collect the targets of keys that give only positions of hands and feet; None where no key does. RequestError for
    joints that are neither."""
    if all(key.what != "limbs" for key in keys):
        return None
    wanted = torch.zeros(motion.num_frames, CANONICAL.num_joints, dtype=torch.bool)
    positions, own = torch.zeros(*wanted.shape, 3, dtype=torch.float64), rig_joint_positions(motion, rigmap)
    for key in keys:
        for name in key.ends:
            limb = effector_joint(name, rigmap)
            wanted[key.frame, limb] = True
            given = key.places.get(name)
            positions[key.frame, limb] = own[key.frame, limb] if given is None else own.new_tensor(given)
    return EffectorTargets(positions, wanted)


def keyframe_errors(made: Motion, source: Motion, keys: Keys, rigmap: RigMap) -> list[dict[str, Any]]:
    """Compute by key the largest error over joints: of positions, cm, and of rotations, degrees, where it gives any."""
    wanted, hips = keys.checked(source), rigmap.joint_of[0]
    distance = 100 * (made.joint_positions() - source.joint_positions()).norm(dim=-1)
    rotation = rotations.multiply(rotations.inverse(source.joint_rotations()), made.joint_rotations())
    angles = torch.rad2deg(rotations.to_rotation_vector(rotation).norm(dim=-1))
    targets = collect_effector_targets(wanted, source, rigmap)
    rows = []
    for key in wanted:
        row: dict[str, Any] = {"frame": key.frame, "what": key.what}
        if key.what == "limbs" and targets is not None:
            miss = (rig_joint_positions(made, rigmap)[key.frame] - targets.places[key.frame]).norm(dim=-1)
            rows.append(row | {"missed_cm": 100 * float(miss[targets.wanted[key.frame]].max())})
            continue
        joints = [hips or 0] if key.what == "root" else list(range(source.num_joints))
        row |= {"missed_cm": float(distance[key.frame, joints].max())}
        rows.append(row | {"missed_deg": float(angles[key.frame, joints].max())})
    return rows


def check_effectors(names: Sequence[str], motion: Motion, rig: Rig | None = None) -> None:
    """Raise RequestError for a name that is no hand or foot of the motion's rig."""
    rigmap = identify_rig(motion.skeleton, rig, motion=motion)
    for name in names:
        effector_joint(name, rigmap)


def effector_joint(name: str, rigmap: RigMap) -> int:
    """Find the canonical joint of an effector, by its canonical name or the rig's own in any case; RequestError, with
    the nearest name, for anything else."""
    names = rigmap.rig_skeleton.names
    known = {c: joint for c, joint in zip(CANONICAL.names, rigmap.joint_of, strict=True) if joint is not None}
    ends = {known[end]: CANONICAL.index(end) for end in LIMBS if end in known}
    joint = find_joint(name, names, lambda: known)
    if joint in ends:
        return ends[joint]
    given = [classify_joint(CANONICAL.names[end]) for end in ends.values()]
    raise RequestError(f"no hand or foot {name!r}; {describe_nearest(name, [names[end] for end in ends], given)}")


def _carries_hips(joint: int, rigmap: RigMap) -> bool:
    """Return whether a joint of the rig is the hips or an ancestor of theirs."""
    own: int | None = rigmap.joint_of[0]
    parents: Sequence[int] = rigmap.rig_skeleton.parents
    while own is not None and own >= 0:
        if own == joint:
            return True
        own = parents[own]
    return False
