"""Proposals whose hips go where the body's own motion takes them (Zhou et al. 2020, section 3.4)."""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool
from torch import Tensor

from mapctl.features import PRIOR_FPS
from mapctl.inbetweening import GapQuery, Proposal
from mapctl.inbetweening.path_closing import close_path
from mapctl.inbetweening.query import estimate_contact_logits
from mapctl.inbetweening.root_trajectory import TREMBLE_HZ, LocalMotion, RootTrajectory
from mapctl.kinematics import heading
from mapctl.motion import Motion
from mapctl.numerics.intervals import true_intervals
from mapctl.numerics.smooth_offsets import smooth_between
from mapctl.protocols import Inbetweener, PathPredictor

SOURCE = "path"
"""Name of the in-betweener in notes, where no other proposes poses."""


@dataclass(frozen=True, eq=False)
class RetracedInbetweener(Inbetweener):
    """In-betweener that lets another propose the poses that are missing, and predicts the hips' trajectory wherever it
    is lost while the body is known: calmed, since hips that are told by how toes move tremble with these."""

    path: PathPredictor
    """Predictor of the trajectory."""
    poses: Inbetweener | None = None
    """In-betweener for missing poses; none where none are missing."""

    @property
    def takes_partial_keys(self) -> bool:
        """As the in-betweener for poses does."""
        return self.poses is not None and self.poses.takes_partial_keys

    def propose(self, query: GapQuery, *, generator: torch.Generator | None = None) -> Proposal:
        """Propose the poses' motion along the predicted trajectory, which leads from the last known position of the
        hips to the next. Gaps in which nothing at all is known keep the trajectory that was proposed with them.
        """
        posed = self._propose_poses(query, generator)
        lost = find_lost_trajectory(query)
        body = query.to_unit_size(posed.motion)
        predicted = predict_trajectory(body, self.path)
        facing = heading(body.local_quat_xyzw[:, 0])
        root = close_path(predicted.integrate(facing[None].float())[0].double(), body.root_position, lost)
        root = smooth_between(root, ~lost, hertz=TREMBLE_HZ, fps=PRIOR_FPS)
        motion = query.to_character(replace(body, root_position=root))
        logits = torch.where(lost[:, None], predicted.contacts[0], posed.contact_logits)
        return replace(posed, motion=motion, contact_logits=logits)

    def _propose_poses(self, query: GapQuery, generator: torch.Generator | None) -> Proposal:
        if self.poses is None:
            return Proposal(query.motion, estimate_contact_logits(query.motion), SOURCE)
        return self.poses.propose(query, generator=generator)


def predict_trajectory(body: Motion, path: PathPredictor) -> RootTrajectory:
    """Predict the trajectory of a whole motion of unit size on canonical joints at PRIOR_FPS, a batch of one."""
    facing = heading(body.local_quat_xyzw[:, 0]).float()
    # Wherever the hips were said to be, even the last bit of the answer must not depend on it.
    body = replace(body, root_position=torch.zeros_like(body.root_position))
    return path.predict(LocalMotion.of_world(body.joint_positions().float()[None], facing[None]))


def find_lost_trajectory(query: GapQuery) -> Bool[Tensor, " frames"]:
    """Find where the hips' position is missing while the body is known at least in part: in intervals of which
    something is known."""
    lost, missing = torch.zeros_like(query.missing.root), query.missing.root
    for _, start, stop in true_intervals(missing[:, None]):
        lost[start:stop] = not bool(query.nothing_known[start:stop].all())
    return lost
