"""What a motion lacks, as priors see it: at their rate, on canonical joints."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from mapctl import rotations
from mapctl.features import PRIOR_FPS
from mapctl.gaps.lost import Lost
from mapctl.motion import Motion
from mapctl.skeleton import CANONICAL, leg_length


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
    def of(canonical: Motion, lost: Lost, joint_of: Sequence[int | None]) -> "CanonicalGap":
        """From the rig's rate. A frame between two of which one is lost shows the other, if that is near enough."""
        whole = canonical.resample(PRIOR_FPS)
        at = torch.arange(whole.num_frames, dtype=torch.float64) * float(canonical.fps) / PRIOR_FPS
        low = (at + 1e-9).floor().long()
        high = torch.where(at - low > 1e-6, low + 1, low).clamp(max=canonical.num_frames - 1)
        nearest, reach = _nearest_known(at, ~lost.frames), 0.5 * float(canonical.fps) / PRIOR_FPS
        between = lost.frames[low] | lost.frames[high]
        # Half open: a key in the middle of two moments is that of one.
        snapped = between & (nearest - at <= reach) & (nearest - at > -reach)
        nearest = nearest.clamp_min(0)
        at = torch.where(snapped, nearest.to(at), at)
        low, high = torch.where(snapped, nearest, low), torch.where(snapped, nearest, high)
        quats = torch.where(snapped[:, None, None], canonical.local_quat_xyzw[nearest], whole.local_quat_xyzw)
        root = torch.where(snapped[:, None], canonical.root_position[nearest], whole.root_position)
        shown = replace(whole, root_position=root, local_quat_xyzw=rotations.sign_continuous(quats))
        columns = [torch.zeros(canonical.num_frames, dtype=torch.bool) if joint is None else lost.joints[:, joint]
                   for joint in joint_of]  # fmt: skip
        turns = torch.stack(columns, dim=1)
        for joint, own in enumerate(joint_of):  # an End Site turns with its parent
            if own is None:
                turns[:, joint] = turns[:, CANONICAL.parents[joint]]
        return CanonicalGap(shown, turns[low] | turns[high], lost.root[low] | lost.root[high],
                             at / float(canonical.fps))  # fmt: skip

    def places_known(self) -> Bool[Tensor, "frames joints"]:
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


def _nearest_known(at: Float[Tensor, " shown"], known: Bool[Tensor, " frames"]) -> Int[Tensor, " shown"]:
    """For each moment, in frames, the nearest one that is known whole; one that is far away if none is."""
    frames = known.nonzero()[:, 0]
    if not len(frames):
        return torch.full_like(at, -len(known), dtype=torch.long)
    after = torch.searchsorted(frames.to(at), at).clamp(max=len(frames) - 1)
    before = (after - 1).clamp_min(0)
    nearer = (frames[before] - at).abs() <= (frames[after] - at).abs()
    return torch.where(nearer, frames[before], frames[after])
