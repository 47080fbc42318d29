"""Keys of in-betweening: which frames of a motion count, what of each does, and how far a motion misses them."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import torch

from mapctl import rotations
from mapctl.errors import RequestError
from mapctl.inbetweening.effector_targets import LIMBS, Targets
from mapctl.inbetweening.missing import Lost
from mapctl.joint_names import find_joint, nearest
from mapctl.joint_parts import role
from mapctl.motion import Motion
from mapctl.retarget import RigMap, places_on_rig, to_canonical
from mapctl.retarget.rigs import Rig
from mapctl.skeleton import CANONICAL

Place = tuple[float, float, float]
"""In a world that stands along Y, metres."""


@dataclass(frozen=True)
class Key:
    """A frame of a motion that counts, and what of it: the whole pose unless less is said."""

    frame: int
    """Of the motion."""
    limbs: tuple[str, ...] = ()
    """Joints of the rig, hands and feet, whose places are all that counts."""
    places: Mapping[str, Place] = field(default_factory=dict)
    """Of such joints, where they are to be, if that is not where the motion has them."""
    root_only: bool = False
    """Only the place and the rotation of the hips counts."""

    def __post_init__(self):
        if self.ends and self.root_only:
            raise RequestError("keys of limbs and keys of the root only are two kinds; choose one")
        for name, place in self.places.items():
            if not all(map(math.isfinite, place)):
                raise RequestError(f"the place of {name} at frame {self.frame} is no three numbers, got {place}")

    @property
    def ends(self) -> tuple[str, ...]:
        """All hands and feet that it tells the place of, if these are all that counts."""
        return tuple(dict.fromkeys((*self.limbs, *self.places)))

    @property
    def what(self) -> Literal["pose", "limbs", "root"]:
        """Of the frame counts."""
        return "limbs" if self.ends else "root" if self.root_only else "pose"

    @property
    def shown(self) -> bool:
        """Whether anything in the motion's own frame counts."""
        return self.what != "limbs" or any(name not in self.places for name in self.limbs)


@dataclass(frozen=True)
class Keys:
    """Which frames of a motion count, and what of them."""

    each: tuple[Key | int, ...]
    """In any order; a number is a whole pose. The first and the last in time must be whole."""

    @staticmethod
    def of(frames: Sequence[int], *, limbs: tuple[str, ...] = (), root_only: bool = False) -> "Keys":
        """The first and the last frame count whole, of those between only limbs or the root if so asked for."""
        if limbs and root_only:
            raise RequestError("keys of limbs and keys of the root only are two kinds; choose one")
        ends = (min(frames), max(frames)) if frames else ()
        return Keys(
            tuple(Key(frame) if frame in ends else Key(frame, limbs=limbs, root_only=root_only) for frame in frames)
        )

    @property
    def frames(self) -> tuple[int, ...]:
        """As they were given."""
        return tuple(key if isinstance(key, int) else key.frame for key in self.each)

    def checked(self, motion: Motion) -> list[Key]:
        """In the order of time, each once; RequestError for those that are not the motion's, for two that differ at one
        frame, for fewer than two, and where the first or the last is no whole pose.
        """
        found: dict[int, Key] = {}
        for one in self.each:
            key = Key(one) if isinstance(one, int) else one
            if not 0 <= key.frame < motion.num_frames:
                raise RequestError(f"the key {key.frame} is not one of the motion's frames 0:{motion.num_frames}")
            if found.setdefault(key.frame, key) != key:
                raise RequestError(f"two different keys are at frame {key.frame}")
        wanted = [found[frame] for frame in sorted(found)]
        if len(wanted) < 2:
            raise RequestError(f"in-betweening needs at least two keys, got {len(wanted)}")
        for key in (wanted[0], wanted[-1]):
            if key.what != "pose":
                raise RequestError(
                    f"the first and the last key are whole poses; that at frame {key.frame} tells the {key.what} only"
                )
        return wanted


def lost_between(keys: Sequence[Key], motion: Motion, rigmap: RigMap) -> Lost:
    """What of a motion the keys do not tell."""
    free = torch.ones(motion.num_frames, dtype=torch.bool)
    free[[key.frame for key in keys if key.what == "pose"]] = False
    joints, root = free[:, None].expand(-1, motion.num_joints).clone(), free.clone()
    above = torch.tensor([_carries_hips(joint, rigmap) for joint in range(motion.num_joints)])
    for key in keys:
        if key.what == "root":
            root[key.frame] = False
            joints[key.frame] = ~above
    return Lost(joints, root)


def targets_of(keys: Sequence[Key], motion: Motion, rigmap: RigMap) -> Targets | None:
    """Where hands and feet are to be; None where no key tells that alone. RequestError for joints that are neither."""
    if all(key.what != "limbs" for key in keys):
        return None
    wanted = torch.zeros(motion.num_frames, CANONICAL.num_joints, dtype=torch.bool)
    places, own = torch.zeros(*wanted.shape, 3, dtype=torch.float64), places_on_rig(motion, rigmap)
    for key in keys:
        for name in key.ends:
            limb = limb_end(name, rigmap)
            wanted[key.frame, limb] = True
            told = key.places.get(name)
            places[key.frame, limb] = own[key.frame, limb] if told is None else own.new_tensor(told)
    return Targets(places, wanted)


def missed_by(made: Motion, source: Motion, keys: Keys, rigmap: RigMap) -> list[dict[str, Any]]:
    """By key, how far what it tells is missed by the joint that misses it by most: places in cm, and rotations in
    degrees where it tells any.
    """
    wanted, hips = keys.checked(source), rigmap.joint_of[0]
    away = 100 * (made.joint_positions() - source.joint_positions()).norm(dim=-1)
    turn = rotations.multiply(rotations.inverse(source.joint_rotations()), made.joint_rotations())
    turned = torch.rad2deg(rotations.to_rotation_vector(turn).norm(dim=-1))
    targets = targets_of(wanted, source, rigmap)
    rows = []
    for key in wanted:
        row: dict[str, Any] = {"frame": key.frame, "what": key.what}
        if key.what == "limbs" and targets is not None:
            off = (places_on_rig(made, rigmap)[key.frame] - targets.places[key.frame]).norm(dim=-1)
            rows.append(row | {"missed_cm": 100 * float(off[targets.wanted[key.frame]].max())})
            continue
        joints = [hips or 0] if key.what == "root" else list(range(source.num_joints))
        rows.append(
            row
            | {"missed_cm": float(away[key.frame, joints].max()), "missed_deg": float(turned[key.frame, joints].max())}
        )
    return rows


def check_limbs(names: Sequence[str], motion: Motion, rig: Rig | None = None) -> None:
    """RequestError for a name that is no hand or foot of the motion's rig."""
    rigmap = to_canonical(motion, rig)[1]
    for name in names:
        limb_end(name, rigmap)


def limb_end(name: str, rigmap: RigMap) -> int:
    """The canonical joint of a limb's end, by its canonical name or the rig's own in any case; RequestError, with the
    nearest name, for anything else."""
    names = rigmap.rig_skeleton.names
    known = {c: joint for c, joint in zip(CANONICAL.names, rigmap.joint_of, strict=True) if joint is not None}
    ends = {known[end]: CANONICAL.index(end) for end in LIMBS if end in known}
    joint = find_joint(name, names, lambda: known)
    if joint in ends:
        return ends[joint]
    told = [role(CANONICAL.names[end]) for end in ends.values()]
    raise RequestError(f"no hand or foot {name!r}; {nearest(name, [names[end] for end in ends], told)}")


def _carries_hips(joint: int, rigmap: RigMap) -> bool:
    """Whether a joint of the rig is the hips or lies above them."""
    own: int | None = rigmap.joint_of[0]
    above: Sequence[int] = rigmap.rig_skeleton.parents
    while own is not None and own >= 0:
        if own == joint:
            return True
        own = above[own]
    return False
