"""What a motion lacks, as priors see it: at their rate, on canonical joints."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from fractions import Fraction

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from mapctl import rotations
from mapctl.features import PRIOR_FPS
from mapctl.inbetweening.missing import MissingMask
from mapctl.motion import Motion
from mapctl.skeleton import CANONICAL, leg_length

_TIE_FRAMES = 1e-6  # frames


@dataclass(frozen=True, eq=False)
class CanonicalGap:
    """The motion at the prior's rate, on canonical joints and the performer's bones, and what of it is lost."""

    motion: Motion
    turns: Bool[Tensor, "frames joints"]
    """Rotations that are lost."""
    root: Bool[Tensor, " frames"]
    """Places of the hips that are lost."""
    seconds: Float[Tensor, " frames"]
    """When each frame is: a key between two frames is taken for one of them, and stays at its own time."""

    @staticmethod
    def of(canonical: Motion, lost: MissingMask, joint_of: Sequence[int | None]) -> "CanonicalGap":
        """From the rig's rate. A frame between two shows the one near it that lacks least, if they lack more."""
        whole = _resample_to_end(canonical)
        at = torch.arange(whole.num_frames, dtype=torch.float64) * float(canonical.fps) / PRIOR_FPS
        at = at.clamp(max=canonical.num_frames - 1)
        low = (at + 1e-9).floor().long()
        high = torch.where(at - low > _TIE_FRAMES, low + 1, low).clamp(max=canonical.num_frames - 1)
        lacking = torch.cat([lost.joints, lost.root[:, None]], dim=1)
        best = _find_most_complete_frames(at, lacking.sum(dim=1))
        snapped = lacking[best].sum(dim=1) < (lacking[low] | lacking[high]).sum(dim=1)
        at = torch.where(snapped, best.to(at), at)
        low, high = torch.where(snapped, best, low), torch.where(snapped, best, high)
        quats = torch.where(snapped[:, None, None], canonical.local_quat_xyzw[best], whole.local_quat_xyzw)
        root = torch.where(snapped[:, None], canonical.root_position[best], whole.root_position)
        shown = replace(whole, root_position=root, local_quat_xyzw=rotations.make_sign_continuous(quats))
        columns = [
            torch.zeros(canonical.num_frames, dtype=torch.bool) if joint is None else lost.joints[:, joint]
            for joint in joint_of
        ]
        turns = torch.stack(columns, dim=1)
        for joint, own in enumerate(joint_of):  # an End Site turns with its parent
            if own is None:
                turns[:, joint] = turns[:, CANONICAL.parents[joint]]
        return CanonicalGap(
            shown, turns[low] | turns[high], lost.root[low] | lost.root[high], at / float(canonical.fps)
        )

    def compute_known_positions(self) -> Bool[Tensor, "frames joints"]:
        """A place is known if all that carries it is."""
        known = [~self.root]
        for parent in CANONICAL.parents[1:]:
            known.append(known[parent] & ~self.turns[:, parent])
        known[0] = ~(self.root | self.turns[:, 0])
        return torch.stack(known, dim=1)

    @property
    def scale(self) -> float:
        """How much longer the performer's legs are than the canonical ones."""
        return leg_length(self.motion.skeleton) / leg_length(CANONICAL)


def _resample_to_end(canonical: Motion) -> Motion:
    """At the prior's rate. Where the very end is far from the last moment it has one of its own."""
    last = canonical.num_frames - 1
    moments = int(last * PRIOR_FPS / canonical.fps) + 1
    over = last * PRIOR_FPS / canonical.fps - (moments - 1)
    if over <= Fraction(1, 2):
        return canonical.resample(PRIOR_FPS)
    frame = torch.arange(canonical.num_frames + math.ceil(canonical.fps / PRIOR_FPS)).clamp(max=last)
    held = replace(
        canonical, root_position=canonical.root_position[frame], local_quat_xyzw=canonical.local_quat_xyzw[frame]
    )
    return held.resample(PRIOR_FPS).slice(0, moments + 1)


def _find_most_complete_frames(at: Float[Tensor, " shown"], lacking: Int[Tensor, " frames"]) -> Int[Tensor, " shown"]:
    """For each moment, in frames, the one that lacks least of those that are nearer to it than to another moment; the
    nearest of several; any other frame if there is none.
    """
    edges = (at[1:] + at[:-1]) / 2 + _TIE_FRAMES  # a frame in the middle of two is the earlier one's
    beyond = at.new_full((1,), torch.inf)
    own, last = at.round().long(), len(lacking) - 1
    reach = math.ceil(float(torch.diff(at).max()) / 2) + 1 if len(at) > 1 else last
    frames = own[:, None] + torch.arange(-reach, reach + 1)
    near = (frames > torch.cat([-beyond, edges])[:, None]) & (frames <= torch.cat([edges, beyond])[:, None])
    inside = near & (frames >= 0) & (frames <= last)
    frames = frames.clamp(0, last)
    cost = lacking[frames] + (frames - at[:, None]).abs() / (2 * reach + 2)
    best = torch.where(inside, cost, torch.inf).argmin(dim=1, keepdim=True)
    return torch.where(inside.any(dim=1), frames.gather(1, best)[:, 0], lacking.argmax())
