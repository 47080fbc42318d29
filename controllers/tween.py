"""In-betweening: a few keys to a whole motion that meets them. What a key tells is no unknown, so it is met to the bit;
where it only tells the place of a hand or a foot, the limb is bent until it is there.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from typing import Any

import torch

from controllers.filling import Infilled, InfillSettings, fill
from mapctl.errors import RequestError
from mapctl.gaps.lost import Lost
from mapctl.gaps.targets import LIMBS, Targets
from mapctl.motion import Motion
from mapctl.protocols import Inbetweener
from mapctl.retarget import RigMap, to_canonical
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
) -> Infilled:  # fmt: skip
    """A motion of the same length that goes through the keys of a motion, of which nothing else counts.

    RequestError for keys that do not fit the motion or its rig.
    """
    wanted = keys.checked(motion)
    canonical, rigmap = to_canonical(motion, rig)
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
        targets = Targets(torch.where(told[..., None], canonical.joint_positions(), 0.0), told)
    return fill(motion, Lost(joints, root), infiller, settings=settings, densities=densities, rig=rig, targets=targets)


def key_errors(made: Motion, source: Motion, keys: Keys) -> list[dict[str, Any]]:
    """By key, how far what it tells is missed: places in cm, rotations in degrees."""
    wanted, rows = keys.checked(source), []
    names = source.skeleton.names
    picked = [names.index(limb) for limb in keys.limbs]
    away = 100 * (made.joint_positions() - source.joint_positions()).norm(dim=-1)
    for number, frame in enumerate(wanted):
        whole = number in (0, len(wanted) - 1) or not (keys.limbs or keys.root_only)
        joints = list(range(len(names))) if whole else picked
        rows.append({"frame": frame, "what": "pose" if whole else "limbs" if picked else "root",
                     "missed_cm": float(away[frame, joints].max()) if joints else float(away[frame, 0])})  # fmt: skip
    return rows


def limb_end(name: str, motion: Motion, rigmap: RigMap) -> int:
    """The canonical joint of a limb's end; RequestError, with the nearest name, for anything else."""
    ends = {motion.skeleton.names[joint]: canonical for canonical, joint in enumerate(rigmap.joint_of)
            if joint is not None and CANONICAL.names[canonical] in LIMBS}  # fmt: skip
    if name in ends:
        return ends[name]
    near = get_close_matches(name, list(ends), n=1, cutoff=0)
    raise RequestError(f"no hand or foot {name!r}; the nearest is {near[0] if near else 'none'}")


def _carries_hips(joint: int, rigmap: RigMap) -> bool:
    """Whether a joint of the rig is the hips or lies above them."""
    own: int | None = rigmap.joint_of[0]
    above: Sequence[int] = rigmap.rig_skeleton.parents
    while own is not None and own >= 0:
        if own == joint:
            return True
        own = above[own]
    return False
