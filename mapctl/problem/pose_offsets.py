"""Unknowns that are offsets of each frame's pose and position about a proposed motion, in sigmas, smooth in time.

x = proposal + sigma * (K z): the posterior of a model that proposes whole motions, as a rollout's x = mu + sigma d is
that of a density, so that the standard normal prior of z is the observation term of denoising (Wang et al. 2019, Eq.
25) in coordinates that converge. K smooths white z to unit variance, so that a correction of one frame moves its
neighbours along. Positions are in the world, not steps from frame to frame: terms on observed positions are then well
conditioned.
"""

from dataclasses import dataclass, field, replace
from functools import cached_property

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mapctl.numerics import gaussian
from mapctl.pose import BodyPose
from mapctl.problem.context import WindowContext, WindowRequest
from mapctl.problem.density_selection import DensityEnsemble
from mapctl.problem.window_solvers import SolvedWindow, minimise_window
from mapctl.solver.budget import Budget, Meter
from mapctl.solver.lbfgs import LbfgsSettings
from mapctl.terms.likelihood import Likelihood
from mapctl.terms.trial import Trial


@dataclass(frozen=True, eq=False)
class PoseOffsets:
    """Unknowns are offsets about a proposal's root position, heading and angles, one batch row a candidate."""

    context: WindowContext
    """What is known before the window. A single density scores the motion with teacher forcing (Eq. 15)."""
    proposal: BodyPose
    """Proposed poses of the window's frames, unbatched."""
    contacts: Bool[Tensor, "frames 2"]
    """Left and right toe planted in each frame."""
    sigma: Float[Tensor, "frames width"]
    """Standard deviations of root, heading and angles (see `BodyPose.pack`): metres and radians."""
    smooth: float = 2.0
    """Sigma of the smoothing, frames."""

    @cached_property
    def _heel_plan(self) -> Trial:
        """The proposal, whose poses say which heels are planted."""
        features = self.proposal.features(self.context.place, self.contacts)
        return self.context.plan_heels(features[None], self.contacts[None])

    @cached_property
    def _smoothing_matrix(self) -> Float[Tensor, "frames frames"]:
        return gaussian.unit_variance_matrix(len(self.sigma), self.smooth, self.sigma.dtype)

    def build(self, unknowns: Float[Tensor, "batch unknowns"]) -> Trial:
        """Build the trials of the proposal with the offsets added; differentiable."""
        white = torch.unflatten(unknowns, -1, self.sigma.shape)
        offset = self.sigma * torch.einsum("ts,bsw->btw", self._smoothing_matrix, white)
        pose = BodyPose.unpack(self.proposal.pack() + offset)
        features = pose.features(self.context.place, self.contacts)
        log_density = None
        if not isinstance(self.context.density, DensityEnsemble):
            log_density = self.context.density.log_prob(features, self.context.expand_state(len(white)))
        contacts = self.contacts.expand(len(white), -1, -1)
        return self.context.build_trial(
            features, contacts, noise=white, log_density=log_density, heel_plan=self._heel_plan
        )

    def warm_start(self, unknowns: Float[Tensor, "1 unknowns"]) -> Float[Tensor, "frames width"]:
        """Return the white offsets by frame, in sigmas."""
        return torch.unflatten(unknowns[0], -1, self.sigma.shape)


@dataclass(frozen=True, eq=False)
class PoseOffsetSolver:
    """L-BFGS over the offsets of a proposed motion, window by window.

    Of an ensemble, the density under which a window's proposal is likeliest scores the window, with less weight where
    the proposal is less likely than that density's own data.
    """

    proposal: BodyPose
    """The proposed motion, unbatched."""
    contacts: Bool[Tensor, "frames 2"]
    """Left and right toe planted in each frame of it."""
    sigma: Float[Tensor, "frames width"]
    """Standard deviations of root, heading and angles by frame (see `BodyPose.pack`): metres and radians."""
    smooth: float = 2.0
    """Sigma of the smoothing, frames."""
    temperature: float = 1.0
    """Temperature of the selected density's likelihood."""
    lbfgs: LbfgsSettings = field(default_factory=lambda: LbfgsSettings(max_iterations=20))
    """Settings of L-BFGS in one window."""
    budget: Budget = field(default_factory=lambda: Budget(evaluations=20))
    """Budget of one window."""
    first_frame: int = 0
    """Frame of the whole motion that the proposal begins at."""

    def __call__(self, request: WindowRequest) -> SolvedWindow:
        """Solve one window; the proposal stays where nothing finite is found.

        The search starts from the proposal, without a warm start: the frames that the last window's offsets were
        smoothed together with are committed now.
        """
        context, terms = request.context, request.terms
        first = context.first_frame - self.first_frame
        stop = first + context.frames
        proposal, contacts = self.proposal.slice(first, stop), self.contacts[first:stop]
        choice = None
        if isinstance(context.density, DensityEnsemble) and context.density.densities:
            choice, state = context.density.select(proposal.features(context.place, contacts), context.state)
            context = replace(context, density=choice.density, state=state)
            terms = (*terms, Likelihood(self.temperature / choice.weight))
        offsets = PoseOffsets(context, proposal, contacts, self.sigma[first:stop], smooth=self.smooth)
        start, meter = torch.zeros(1, offsets.sigma.numel()), Meter(self.budget.within(request.seconds))
        return replace(minimise_window(offsets, terms, start, self.lbfgs, meter), choice=choice)
