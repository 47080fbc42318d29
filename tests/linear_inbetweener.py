"""An in-betweener written from mapctl.protocols alone: positions and quaternions go straight from key to key."""

import torch

from mapctl.inbetweening import GapQuery, Proposal
from mapctl.motion import Motion
from mapctl.numerics.intervals import fill_missing
from mapctl.protocols import Inbetweener


class LinearInbetweener(Inbetweener):
    def propose(self, query: GapQuery, *, generator: torch.Generator | None = None) -> Proposal:
        motion, missing = query.motion, query.missing
        root = fill_missing(motion.root_position[None], ~missing.root[None])[0]
        turns = fill_missing(motion.local_quat_xyzw.transpose(0, 1), ~missing.joints.T).transpose(0, 1)
        result = Motion(motion.skeleton, motion.fps, root, torch.nn.functional.normalize(turns, dim=-1))
        return Proposal(result, torch.zeros(motion.num_frames, 2), "linear")
