"""Tertiary blending (infilling paper, section 4.2): a hand or foot does for a while what it does in another motion."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from controllers.filling import Infilled, InfillSettings, fill
from controllers.keys import limb_end
from mapctl import rotations
from mapctl.errors import RequestError
from mapctl.gaps.lost import Lost
from mapctl.gaps.targets import LIMBS, Targets
from mapctl.kinematics import heading
from mapctl.motion import Motion
from mapctl.protocols import Inbetweener
from mapctl.retarget import to_canonical
from mapctl.rigs import Rig
from mapctl.skeleton import CANONICAL


@dataclass(frozen=True)
class Borrowed:
    """What is taken, and where it goes."""

    limbs: tuple[str, ...]
    """Hands and feet, by the names of the rig that gets them."""
    start: int
    """First frame of the source that is taken."""
    stop: int
    """One past the last."""
    at: int
    """Frame of the motion that the first one goes to."""
    margin: float = 0.5
    """Seconds before and after in which the limb is free to go there and back."""


def blend(
    motion: Motion, source: Motion, borrowed: Borrowed, infiller: Inbetweener | None, *,
    settings: InfillSettings | None = None, densities: Sequence[Any] = (), rig: Rig | None = None,
) -> Infilled:  # fmt: skip
    """The motion with its limbs where the source's are, seen from shoulder or hip, in size; all else stays to the bit.

    RequestError for frames that either motion has not, and for joints that are no hand or foot.
    """
    source = source if source.fps == motion.fps else source.resample(motion.fps)
    _check(motion, source, borrowed)
    own, rigmap = to_canonical(motion, rig)
    other, _ = to_canonical(source)
    ends = [limb_end(name, rigmap) for name in borrowed.limbs]
    there = slice(borrowed.at, borrowed.at + borrowed.stop - borrowed.start)
    margin = round(borrowed.margin * float(motion.fps))
    free = slice(max(0, there.start - margin), min(motion.num_frames, there.stop + margin))
    joints = torch.zeros(motion.num_frames, motion.num_joints, dtype=torch.bool)
    places = torch.zeros_like(own.joint_positions())
    wanted = torch.zeros(places.shape[:2], dtype=torch.bool)
    for end in ends:
        limb = LIMBS[CANONICAL.names[end]]
        for joint in (limb.upper, limb.lower, limb.end):
            rigged = rigmap.joint_of[joint]
            if rigged is not None:
                joints[free, rigged] = True
        places[there, end] = _carried_over(own, other, limb.upper, end, borrowed)
        wanted[there, end] = True
    lost = Lost(joints, torch.zeros(motion.num_frames, dtype=torch.bool))
    done = fill(
        motion, lost, infiller, settings=settings, densities=densities, rig=rig, targets=Targets(places, wanted)
    )
    return replace(done, notes=(*done.notes, f"frames {free.start}:{free.stop} of {', '.join(borrowed.limbs)} are new"))


def _carried_over(own: Motion, other: Motion, root: int, end: int, borrowed: Borrowed) -> Tensor:
    """Where the limb's end is to be: as far from its own root as the source's is, in the length of its own bones."""
    there = slice(borrowed.at, borrowed.at + borrowed.stop - borrowed.start)
    here = slice(borrowed.start, borrowed.stop)
    theirs = other.joint_positions()[here]
    way = theirs[:, end] - theirs[:, root]
    turn = heading(own.local_quat_xyzw[there, 0]) - heading(other.local_quat_xyzw[here, 0])
    way = rotations.rotate(rotations.about_y(turn), way)
    return own.joint_positions()[there, root] + way * _length(own, root, end) / _length(other, root, end)


def _length(motion: Motion, root: int, end: int) -> float:
    """Of a limb's two bones, metres."""
    middle = motion.skeleton.parents[end]
    assert motion.skeleton.parents[middle] == root
    return float(motion.skeleton.offsets[[middle, end]].norm(dim=-1).sum())


def _check(motion: Motion, source: Motion, borrowed: Borrowed) -> None:
    if not borrowed.limbs:
        raise RequestError("blending needs a hand or a foot")
    if not 0 <= borrowed.start < borrowed.stop <= source.num_frames:
        raise RequestError(f"frames {borrowed.start}:{borrowed.stop} are not within the source's 0:{source.num_frames}")
    last = borrowed.at + borrowed.stop - borrowed.start
    if not 0 <= borrowed.at < last <= motion.num_frames:
        raise RequestError(f"frames {borrowed.at}:{last} are not within the motion's 0:{motion.num_frames}")
    if not 0 <= borrowed.margin <= 10:
        raise RequestError(f"the margin must lie between 0 and 10 seconds, got {borrowed.margin:g}")
