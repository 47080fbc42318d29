"""In-betweening: a few keys to a whole motion that meets them. What a key tells is no unknown, so it is met to the bit;
where it only tells the place of a hand or a foot, the limb is bent until it is there.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from difflib import get_close_matches
from typing import Any

import torch

from controllers import feasibility
from controllers.filling import Another, Infilled, InfillSettings, fill
from mapctl import rotations
from mapctl.errors import RequestError
from mapctl.gaps.lost import Lost, straight
from mapctl.gaps.targets import LIMBS, Targets
from mapctl.motion import Motion
from mapctl.protocols import Inbetweener
from mapctl.retarget import RigMap, places_on_rig, settled, to_canonical
from mapctl.rigs import Rig
from mapctl.skeleton import CANONICAL


@dataclass(frozen=True)
class Keys:
    """Which frames of a motion count, and what of them."""

    frames: tuple[int, ...]
    """In any order; the first and the last count whole."""
    limbs: tuple[str, ...] = ()
    """Joints of the rig whose places are all that counts of the others: hands and feet."""
    root_only: bool = False
    """Of the others only the place and the rotation of the hips counts."""

    def __post_init__(self):
        if self.limbs and self.root_only:
            raise RequestError("keys of limbs and keys of the root only are two kinds; choose one")

    def checked(self, motion: Motion) -> list[int]:
        """In the order of time, each once; RequestError for those that are not the motion's, and fewer than two."""
        wanted = sorted(set(self.frames))
        beyond = [key for key in wanted if not 0 <= key < motion.num_frames]
        if beyond:
            raise RequestError(f"the key {beyond[0]} is not one of the motion's frames 0:{motion.num_frames}")
        if len(wanted) < 2:
            raise RequestError(f"in-betweening needs at least two keys, got {len(wanted)}")
        return wanted


def tween(
    motion: Motion, keys: Keys, infiller: Inbetweener | None, *,
    settings: InfillSettings | None = None, densities: Sequence[Any] = (), rig: Rig | None = None,
    another: Another | None = None,
) -> Infilled:  # fmt: skip
    """A motion of the same length that goes through the keys of a motion, of which nothing else counts.

    RequestError for keys that do not fit the motion or its rig; keys that nobody could reach in time get a note.
    """
    wanted = keys.checked(motion)
    shown = _shown_by(wanted, motion)
    canonical, rigmap = to_canonical(shown, rig)
    limbs = [limb_end(name, motion, rigmap) for name in keys.limbs]
    whole = [wanted[0], wanted[-1]] if keys.limbs or keys.root_only else wanted
    free = torch.ones(motion.num_frames, dtype=torch.bool)
    free[whole] = False
    joints, root = free[:, None].expand(-1, motion.num_joints).clone(), free.clone()
    between, targets = wanted[1:-1], None
    if keys.root_only:
        root[between] = False
        joints[between] = torch.tensor([not _carries_hips(joint, rigmap) for joint in range(motion.num_joints)])
    elif limbs and between:
        told = torch.zeros(motion.num_frames, CANONICAL.num_joints, dtype=torch.bool)
        for limb in limbs:
            told[between, limb] = True
        targets = Targets(torch.where(told[..., None], places_on_rig(shown, rigmap), 0.0), told)
    rooted = wanted if keys.root_only else whole
    hasty = feasibility.between_keys(motion, canonical.root_position, told=~joints, keys=rooted)
    done = fill(motion, Lost(joints, root), infiller, settings=settings, densities=densities, rig=settled(rigmap),
                targets=targets, another=another)  # fmt: skip
    return replace(done, notes=(*hasty, *done.notes))


def _shown_by(wanted: Sequence[int], motion: Motion) -> Motion:
    """All that counts: the keys, and straight lines between them. From these the rig is told, too."""
    free = torch.ones(motion.num_frames, dtype=torch.bool)
    free[list(wanted)] = False
    return straight(motion, Lost(free[:, None].expand(-1, motion.num_joints).clone(), free))


def key_errors(made: Motion, source: Motion, keys: Keys, rig: Rig | None = None) -> list[dict[str, Any]]:
    """By key, how far what it tells is missed by the joint that misses it by most: places in cm, and rotations in
    degrees where it tells any.
    """
    wanted, names = keys.checked(source), source.skeleton.names
    hips: int | None = to_canonical(_shown_by(wanted, source), rig)[1].joint_of[0]
    away = 100 * (made.joint_positions() - source.joint_positions()).norm(dim=-1)
    turn = rotations.multiply(rotations.inverse(source.joint_rotations()), made.joint_rotations())
    turned = torch.rad2deg(rotations.to_rotation_vector(turn).norm(dim=-1))
    rows = []
    for frame in wanted:
        if frame in (wanted[0], wanted[-1]) or not (keys.limbs or keys.root_only):
            what, joints = "pose", list(range(len(names)))
        else:
            what, joints = ("root", [hips or 0]) if keys.root_only else ("limbs", [names.index(n) for n in keys.limbs])
        row = {"frame": frame, "what": what, "missed_cm": float(away[frame, joints].max())}
        rows.append(row if what == "limbs" else {**row, "missed_deg": float(turned[frame, joints].max())})
    return rows


def limb_end(name: str, motion: Motion, rigmap: RigMap) -> int:
    """The canonical joint of a limb's end; RequestError, with the nearest name, for anything else."""
    ends = {motion.skeleton.names[joint]: canonical for canonical, joint in enumerate(rigmap.joint_of)
            if joint is not None and CANONICAL.names[canonical] in LIMBS}  # fmt: skip
    if name in ends:
        return ends[name]
    lower = {end.lower(): end for end in ends}
    near = get_close_matches(name.lower(), list(lower), n=1, cutoff=0)
    raise RequestError(f"no hand or foot {name!r}; the nearest is {lower[near[0]] if near else 'none'}")


def _carries_hips(joint: int, rigmap: RigMap) -> bool:
    """Whether a joint of the rig is the hips or lies above them."""
    own: int | None = rigmap.joint_of[0]
    above: Sequence[int] = rigmap.rig_skeleton.parents
    while own is not None and own >= 0:
        if own == joint:
            return True
        own = above[own]
    return False
