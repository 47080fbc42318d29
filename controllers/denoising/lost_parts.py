"""Joints that a capture lacks for a while: a denoiser's answer, and there an in-betweener's."""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool
from torch import Tensor

from mapctl.features import PRIOR_FPS
from mapctl.inbetweening import GapQuery
from mapctl.inbetweening.missing import MissingMask
from mapctl.numerics.intervals import true_intervals
from mapctl.pose import BodyPose
from mapctl.protocols import Denoiser, Inbetweener
from mapctl.recording import Capture, CaptureProposal

_LOST_FRAMES = 8
"""Fewest consecutive frames without a joint that an in-betweener fills; shorter ones are the denoiser's own."""


@dataclass(frozen=True, eq=False)
class LostPartFiller(Denoiser):
    """A denoiser that leaves what is lost for longer to an in-betweener, which is shown all else denoised."""

    denoiser: Denoiser
    """Proposes what was observed, or lost for a moment."""
    inbetweener: Inbetweener
    """Proposes what was lost for longer."""

    def clean(self, capture: Capture) -> CaptureProposal:
        """Propose a motion of the capture's frames, on canonical bones at PRIOR_FPS.

        The denoiser's own answer stands for a batch of several captures, and where everything is lost throughout.
        """
        found = self.denoiser.clean(capture)
        lost = MissingMask(_find_lost(~capture.seen[0]), _find_lost(~capture.seen_root[0][:, None])[:, 0])
        if len(capture.root) != 1 or not (lost.joints.any() or lost.root.any()) or lost.joints.all():
            return found
        motion = BodyPose(**{name: values[0] for name, values in vars(found.pose).items()}).motion()
        seconds = torch.arange(motion.num_frames, dtype=torch.float64) / PRIOR_FPS
        proposed = self.inbetweener.propose(GapQuery(motion, lost, seconds)).motion
        root = torch.where(lost.root[:, None], proposed.root_position, motion.root_position)
        quats = torch.where(lost.joints[..., None], proposed.local_quat_xyzw, motion.local_quat_xyzw)
        pose = BodyPose.of_motion(replace(motion, root_position=root, local_quat_xyzw=quats))
        return replace(found, pose=BodyPose(**{name: values[None] for name, values in vars(pose).items()}))


def _find_lost(unseen: Bool[Tensor, "frames columns"]) -> Bool[Tensor, "frames columns"]:
    lost = torch.zeros_like(unseen)
    for column, start, stop in true_intervals(unseen):
        lost[start:stop, column] = stop - start >= _LOST_FRAMES
    return lost
