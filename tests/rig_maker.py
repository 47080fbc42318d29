"""People on any rig: skeletons of any naming, rest pose, size and axes, and motion on them that looks like walking."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from helpers import random_motion, walk
from scipy.spatial.transform import Rotation
from torch import Tensor

from mapctl import rotations
from mapctl.motion import Motion
from mapctl.retarget import rigs
from mapctl.skeleton import CANONICAL, Skeleton, mirror_name

_SIDES = (("left", 1.0), ("right", -1.0))


@dataclass(frozen=True)
class Make:
    """Settings of a rig to build."""

    names: Mapping[str, str]
    """Canonical joint to the rig's name; joints that are not named are left out."""
    size: float = 1.0
    """Size over that of the canonical body."""
    arms_down_deg: float = 0.0
    """Angle of the arms in the rest pose: 0 is a T-pose."""
    bones_along_x: bool = False
    """A rest pose that is none, every bone along its joint's x axis."""
    zup: bool = False
    """A file whose world has Z up."""
    turned_deg: float = 0.0
    """The way the rest pose faces, about the vertical."""
    extras: bool = True
    """Joints that the canonical skeleton lacks: spine, twist, fingers, a prop."""
    root: str | None = None
    """Name of a joint on the ground above the hips."""
    end_sites: bool = True
    """Whether feet and hands without further joints end in End Sites."""
    swapped: bool = False
    """Whether left is called right."""
    between: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    """Joints between a canonical joint and the one above it, from above: halves of limbs, which twist about their
    bone."""
    hanging: Mapping[str, str] = field(default_factory=dict)
    """The rig's name of what a canonical joint hangs from, where it is not the canonical joint above it."""
    further: Mapping[str, str] = field(default_factory=dict)
    """Joints at the ends, and the canonical joint that they hang from."""


@dataclass(frozen=True, eq=False)
class Generated:
    """A rig, and what it is in truth."""

    skeleton: Skeleton
    """Names, tree, offsets."""
    tpose: Mapping[str, Rotation]
    """World rotation (Y up) of each canonical joint's rig joint in the T-pose."""
    upright: Rotation
    """Turns the file's world so that Y is up."""
    joint: Mapping[str, str]
    """Canonical joint to the rig's name."""
    twisting: frozenset[str] = frozenset()
    """Joints that turn about their bone alone."""

    def motion(self, canonical: Motion) -> Motion:
        """The canonical motion on this rig, with the rig's further joints turning at random and the root travelling."""
        frames, names = canonical.num_frames, self.skeleton.names
        world = {name: Rotation.from_quat(canonical.joint_rotations()[:, c]) for c, name in enumerate(CANONICAL.names)}
        noise = random_motion(self.skeleton, frames, seed=5).local_quat_xyzw
        still = torch.tensor([0.0, 0, 0, 1], dtype=torch.float64)
        of = {self.joint[c]: c for c in self.joint}
        local, turned = [], []
        for k, name in enumerate(names):
            parent = self.skeleton.parents[k]
            above = turned[parent] if parent >= 0 else Rotation.identity(frames)
            if name in of:
                wanted = self.upright.inv() * world[of[name]] * self.tpose[of[name]]
                local.append(torch.from_numpy((above.inv() * wanted).as_quat()))
            elif parent < 0 or k < names.index(self.joint["hips"]):
                local.append(still.expand(frames, 4))
            else:
                turn = rotations.slerp(still.expand(frames, 4), noise[:, k], torch.full((frames,), 0.1).double())
                local.append(self._about_bone(k, turn) if name in self.twisting else turn)
            turned.append(above * Rotation.from_quat(local[-1].numpy()))
        hips = torch.from_numpy(self.upright.inv().apply(canonical.root_position.numpy()))
        motion = Motion(self.skeleton, canonical.fps, hips, rotations.make_sign_continuous(torch.stack(local, 1)))
        own = names.index(self.joint["hips"])
        return motion if own == 0 else replace(motion, root_position=hips - motion.joint_positions()[:, own] + hips)

    def _about_bone(self, joint: int, turn: Tensor) -> Tensor:
        """The turn of a joint, about its bone alone; of one from which several hang, none."""
        below = self.skeleton.children(joint)
        bone = torch.nn.functional.normalize(self.skeleton.offsets[below[0]], dim=0)
        twist = rotations.from_rotation_vector(bone * (rotations.to_rotation_vector(turn) @ bone)[:, None])
        return twist if len(below) == 1 else rotations.from_rotation_vector(torch.zeros(len(turn), 3).double())


def names_of(preset: str, version: int = 0) -> dict[str, str]:
    """The names of a listed rig, in one of its versions."""
    rig = next(rig for rig in rigs.known_rigs() if rig.name == preset)
    listed = {c: (own, *rig.aliases.get(c, ())) for c, own in rig.joints.items()}
    return {c: names[min(version, len(names) - 1)] for c, names in listed.items()}


def versions_of(preset: str) -> int:
    """In how many ways a listed rig is written."""
    rig = next(rig for rig in rigs.known_rigs() if rig.name == preset)
    return 1 + max(len(rig.aliases.get(c, ())) for c in ("hips", "leftUpperArm", "leftFoot"))


def make(wanted: Make) -> Generated:
    """The rig that is wanted, with the truth about its T-pose."""
    upright = Rotation.from_euler("x", -90, degrees=True) if wanted.zup else Rotation.identity()
    facing = Rotation.from_euler("y", wanted.turned_deg, degrees=True)
    names = wanted.names if not wanted.swapped else {c: wanted.names[mirror_name(c)] for c in wanted.names}
    # With all rotations zero a joint's own axes are the file's, while its body part is turned as in the rest pose.
    tpose = {c: _along_x(c) if wanted.bones_along_x else _rest(c, wanted).inv() * facing.inv() * upright for c in names}
    frame = {names[c]: tpose[c] for c in names} | ({wanted.root: upright} if wanted.root else {})
    placed = dict(zip(CANONICAL.names, wanted.size * _positions(), strict=True))
    joints = _parents_first(_joints(wanted, names, placed, frame))
    order, at = [name for name, _, _ in joints], {name: position for name, _, position in joints}
    offsets = [torch.zeros(3).double()]
    for name, parent, _ in joints[1:]:
        offsets.append(torch.from_numpy(frame[parent].inv().apply((at[name] - at[parent]).numpy())))
    parents = tuple(order.index(parent) if parent else -1 for _, parent, _ in joints)
    ends = {}
    if wanted.end_sites:
        ends = {names[c]: tuple(frame[names[c]].inv().apply(tip.numpy()).tolist()) for c, tip in _tips(names, placed)}
    skeleton = Skeleton(tuple(order), parents, torch.stack(offsets), ends)
    return Generated(
        skeleton, tpose, upright, names, frozenset(name for chain in wanted.between.values() for name in chain)
    )


def _tips(names: Mapping[str, str], placed: Mapping[str, Tensor]):
    """Where feet end: at the tips of toes, or where toes would be."""
    for side, _ in _SIDES:
        if side + "Toes" in names:
            yield side + "Toes", torch.tensor([0.0, 0.0, 0.07]).double()
        else:
            yield side + "Foot", placed[side + "Toes"] - placed[side + "Foot"]


def _joints(wanted: Make, names: Mapping[str, str], placed: Mapping[str, Tensor], frame: dict[str, Rotation]):
    """Name, parent and place in the T-pose of every joint."""
    joints = []
    if wanted.root:
        joints.append((wanted.root, "", placed["hips"] - torch.tensor([0.0, 0.9, 0.0]).double() * wanted.size))
    for c in CANONICAL.names:
        if c in names:
            above = CANONICAL.parents[CANONICAL.index(c)]
            while above >= 0 and CANONICAL.names[above] not in names:
                above = CANONICAL.parents[above]
            parent = names[CANONICAL.names[above]] if above >= 0 else wanted.root or ""
            if above >= 0:
                parent = _put_between(wanted, c, parent, joints, placed, frame)
            joints.append((names[c], wanted.hanging.get(c, parent), placed[c]))
    for name, c in wanted.further.items():
        joints.append((name, names[c], placed[c] + torch.tensor([0.0, 0.02, 0.01]).double()))
        frame[name] = frame[names[c]]
    return _with_extras(joints, names, placed, frame) if wanted.extras else joints


def _put_between(wanted: Make, c: str, parent: str, joints, placed: Mapping[str, Tensor], frame: dict[str, Rotation]):
    """Put the joints between a canonical joint and the one above it, and return the last of them."""
    chain, known = wanted.between.get(c, ()), {name: position for name, _, position in joints}
    start, stop = known[parent], placed[c]
    for number, name in enumerate(chain):
        shared = sum(name in other for other in wanted.between.values()) > 1
        if name not in known:
            position = start - torch.tensor([0.0, 0.02, 0.0]).double() if shared else None
            share = (number + 1) / (len(chain) + 1)
            joints.append((name, parent, start + (stop - start) * share if position is None else position))
            frame[name] = frame[parent]
        parent = name
    return parent


def person(size: float = 1.0, frames: int = 40) -> Motion:
    """A canonical walk of a body of this size."""
    motion = walk(frames)
    skeleton = replace(motion.skeleton, offsets=motion.skeleton.offsets * size, end_offsets={})
    return replace(motion, skeleton=skeleton, root_position=motion.root_position * size)


def _positions() -> Tensor:
    positions = [torch.zeros(3).double()]
    for offset, parent in zip(CANONICAL.offsets[1:], CANONICAL.parents[1:], strict=True):
        positions.append(positions[parent] + offset)
    return torch.stack(positions)


def _rest(c: str, wanted: Make) -> Rotation:
    """How the rest pose turns a canonical joint away from the T-pose."""
    for side, sign in _SIDES:
        part = c.removeprefix(side)
        if part in ("UpperArm", "LowerArm", "Hand"):
            return Rotation.from_euler("z", -sign * wanted.arms_down_deg, degrees=True)
    return Rotation.identity()


def _along_x(c: str) -> Rotation:
    """Every bone along x; y forward, but on feet and toes up."""
    forward = (0.0, 0.0, 1.0)
    x, y = (0.0, 1.0, 0.0), forward
    for side, sign in _SIDES:
        part = c.removeprefix(side) if c.startswith(side) else ""
        if part in ("Shoulder", "UpperArm", "LowerArm", "Hand"):
            x = (sign, 0.0, 0.0)
        elif part in ("UpperLeg", "LowerLeg"):
            x = (0.0, -1.0, 0.0)
        elif part == "Foot":
            x, y = (0.0, -0.6372, 0.7707), (0.0, 0.7707, 0.6372)
        elif part == "Toes":
            x, y = forward, (0.0, 1.0, 0.0)
    return Rotation.from_matrix(np.stack([x, y, np.cross(x, y)], axis=1))


def _with_extras(joints, names, placed, frame):
    """An extra spine joint, a forearm twist, fingers, and a prop in the hand."""
    chest = next(c for c in ("chest", "spine") if c in names)
    if chest == "chest":
        middle = (placed["spine"] + placed["chest"]) / 2
        joints = [(n, "Middle" if n == names["chest"] else p, at) for n, p, at in joints]
        joints.append(("Middle", names["spine"], middle))
        frame["Middle"] = frame[names["spine"]]
    for k, side in enumerate(("left", "right")):
        arm, hand = names[side + "LowerArm"], names.get(side + "Hand")
        joints.append((f"{arm}_twist_01", arm, (placed[side + "LowerArm"] + placed[side + "Hand"]) / 2))
        frame[f"{arm}_twist_01"] = frame[arm]
        if hand is None:
            continue
        tip = placed[side + "Hand"]
        for finger in ("Thumb1", "Index1"):
            name = f"{'LR'[k]}_{finger}_bone"
            tip = tip + torch.tensor([0.03 if k == 0 else -0.03, 0.0, 0.02]).double()
            joints.append((name, hand, tip))
            frame[name] = frame[hand]
    if "rightHand" in names:
        joints.append(("Prop_sword", names["rightHand"], placed["rightHand"] + 0.1))
        frame["Prop_sword"] = frame[names["rightHand"]]
    return joints


def _parents_first(joints):
    done, left = [], list(joints)
    while left:
        ready = [j for j in left if not j[1] or j[1] in {name for name, _, _ in done}]
        done.append(ready[0])
        left.remove(ready[0])
    return done
