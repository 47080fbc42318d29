"""Unknowns of a window: the noise of a rollout, or offsets about a proposed motion.

Noise: x = mu_k + sigma_k d, components k and contact bits fixed by a plan. Offsets: x = proposal + sigma * (K z), the
posterior of a model that proposes whole motions, so that the standard normal prior of z is the observation term of
denoising (Wang et al. 2019, Eq. 25) in coordinates that converge. K smooths white z to unit variance, so that a
correction of one frame moves its neighbours along; positions are in the world, so that terms on observed positions are
well conditioned.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mapctl.errors import MapctlError
from mapctl.features import LAYOUT, GroundPose
from mapctl.kinematics import fast
from mapctl.numerics import gaussian
from mapctl.pose import BodyPose
from mapctl.problem.density_selection import DensityEnsemble
from mapctl.problem.objective import Parametrisation
from mapctl.protocols import AnyDensity, DensityState, DiscreteChoices, PreparedRollout
from mapctl.skeleton import CANONICAL, Skeleton
from mapctl.terms.base import Term, TrialGradient
from mapctl.terms.trial import Trial


@dataclass(frozen=True, eq=False)
class WindowContext:
    """Context before a window, as far as its frames depend on it."""

    density: AnyDensity | DensityEnsemble
    """Density, or several of which the solver selects one."""
    state: DensityState | tuple[DensityState, ...]
    """Density's state after the committed frames, batch of one or one row a candidate; a tuple for an ensemble."""
    ground_pose: GroundPose
    """Ground pose of the last committed frame."""
    before: Float[Tensor, "past joints 3"]
    """World joint positions of the last committed frames, metres, oldest first."""
    frames: int
    """Number of frames in the window."""
    skeleton: Skeleton = CANONICAL
    """Bones of the character."""
    contacts_before: Bool[Tensor, "*batch 2"] = field(default_factory=lambda: torch.zeros(2, dtype=torch.bool))
    """Left and right toe planted in the last committed frame; unbatched or one row a candidate."""
    heels_before: Float[Tensor, "known 2 3"] = field(default_factory=lambda: torch.zeros(0, 2, 3))
    """World positions of the heels in the last committed frame, metres; none where it is not known."""
    first_frame: int = 0
    """Frame of the whole motion with which the window begins, from 0."""

    @property
    def prior(self) -> AnyDensity:
        """The one density; MapctlError for an ensemble."""
        if isinstance(self.density, DensityEnsemble):
            raise MapctlError("a rollout needs one density, not an ensemble")
        return self.density

    @property
    def prior_state(self) -> DensityState:
        """The one density's state."""
        assert not isinstance(self.state, tuple)
        return self.state

    def build_trial(
        self,
        features: Float[Tensor, "batch frames size"],
        contacts: Bool[Tensor, "batch frames 2"],
        noise: Float[Tensor, "batch frames width"] | None = None,
        log_density: Float[Tensor, "batch frames"] | None = None,
    ) -> Trial:
        """Build the trial of candidate features, physical units, in this context."""
        return Trial(
            features,
            self.ground_pose,
            contacts=contacts,
            noise=noise,
            log_density=log_density,
            before=self.before,
            contacts_before=self.contacts_before,
            heels_before=self.heels_before,
            skeleton=self.skeleton,
            first_frame=self.first_frame,
        )


@dataclass(frozen=True, eq=False)
class WindowRequest:
    """One window to solve."""

    context: WindowContext
    """Context before the window."""
    terms: Sequence[Term]
    """Terms whose energies are summed over the window's frames."""
    warm_start: Float[Tensor, "ahead width"]
    """Result of the last window for the first of these frames (see `SolvedWindow`); none at the start.
    """
    generator: torch.Generator
    """Source of all random draws."""
    seconds: float = math.inf
    """Time that is left, seconds."""


@dataclass(frozen=True, eq=False)
class LatentNoise(Parametrisation):
    """Unknowns are the standard normal numbers d of a rollout, one batch row a candidate."""

    context: WindowContext
    """Context before the window."""
    plan: DiscreteChoices
    """Components and contact bits of each frame."""
    prepared: PreparedRollout | None = None
    """Rollouts of as many candidates as the plan is for, where they are prepared already."""
    heel_plan: Trial | None = None
    """Motion whose poses determine which heels are planted; None: see `holds_heels`."""
    holds_heels: bool = False
    """Whether the first trial that is built is that motion; if not, each candidate's own poses count."""

    @staticmethod
    def from_unknowns(context: WindowContext, unknowns: Float[Tensor, "batch unknowns"]) -> "LatentNoise":
        """Plan the likeliest components and contact bits along the rollout of the unknowns."""
        noise = torch.unflatten(unknowns.detach(), -1, (context.frames, LAYOUT.continuous))
        return LatentNoise(context, context.prior.plan(context.prior_state.expand(len(noise)), noise))

    @staticmethod
    def begin_search(context: WindowContext, start: Float[Tensor, "batch unknowns"]) -> "LatentNoise":
        """Plan like `from_unknowns`, for a search that evaluates the start first: its rollout is done only once."""
        noise = torch.unflatten(start.detach(), -1, (context.frames, LAYOUT.continuous))
        planned = context.prior.plan_search(context.prior_state.expand(len(noise)), noise)
        return LatentNoise(context, *planned, holds_heels=True)

    def build(self, unknowns: Float[Tensor, "batch unknowns"]) -> Trial:
        """Build the trials of the noise by a rollout of the density; differentiable."""
        context = self.context
        noise = torch.unflatten(unknowns, -1, (context.frames, LAYOUT.continuous))
        plan = self._expand_plan(len(noise))
        features, log_density = context.prior.rollout(context.prior_state.expand(len(noise)), noise, plan)
        return self._hold_heels(context.build_trial(features, plan.contacts, noise, log_density))

    def build_detached(self, unknowns: Float[Tensor, "batch unknowns"]) -> Trial | None:
        context = self.context
        noise = torch.unflatten(unknowns.detach(), -1, (context.frames, LAYOUT.continuous))
        if not fast.is_supported(noise, context.ground_pose, context.skeleton):
            return None
        features, log_density = self._rollout.roll_out(noise)
        poses = fast.WorldPoses.compute(features, context.ground_pose, context.skeleton)
        trial = context.build_trial(features, self.plan.contacts, noise, log_density)
        return self._hold_heels(replace(trial, world_poses=poses))

    def pull_back(self, trial: Trial, gradient: TrialGradient) -> Float[Tensor, "batch unknowns"]:
        assert trial.world_poses is not None
        on_world = (gradient.root_xz_world, gradient.heading, gradient.joints_world, gradient.heels_world)
        d_features = gradient.features + trial.world_poses.pull_back(*on_world)
        d_noise = self._rollout.pull_back(torch.as_tensor(d_features), torch.as_tensor(gradient.log_density))
        return (d_noise + torch.as_tensor(gradient.noise)).flatten(1)

    @cached_property
    def _rollout(self) -> PreparedRollout:
        """Rollouts of as many candidates as the plan is for."""
        state = self.context.prior_state.expand(len(self.plan.contacts))
        return self.prepared or self.context.prior.prepare_rollout(state, self.plan)

    def _hold_heels(self, trial: Trial) -> Trial:
        """Let the planned motion determine which heels are planted in a trial."""
        if self.holds_heels and not self._held:
            self._held.append(replace(trial, features=trial.features.detach(), noise=None, log_density=None))
        plan = self._held[0] if self._held else self.heel_plan
        return trial if plan is None else replace(trial, heel_plan=plan)

    @cached_property
    def _held(self) -> list[Trial]:
        """The first trial that was built, without a gradient."""
        return []

    def _expand_plan(self, batch: int) -> DiscreteChoices:
        return DiscreteChoices(
            self.plan.component.expand(batch, -1).contiguous(), self.plan.contacts.expand(batch, -1, -1).contiguous()
        )


SMOOTH_FRAMES = 2.0
"""Frames (sigma) over which offsets are smoothed: what moves one frame moves its neighbours along."""


@dataclass(frozen=True, eq=False)
class PoseOffsets(Parametrisation):
    """Unknowns are offsets about a proposal's root position, heading and angles, one batch row a candidate."""

    context: WindowContext
    """Context before the window. A single density scores the motion with teacher forcing (Eq. 15)."""
    proposal: BodyPose
    """Proposed poses of the window's frames, unbatched."""
    contacts: Bool[Tensor, "frames 2"]
    """Left and right toe planted in each frame."""
    sigma: Float[Tensor, "frames width"]
    """Standard deviations of root, heading and angles (see `BodyPose.pack`): metres and radians."""

    @cached_property
    def _heel_plan(self) -> Trial:
        """The proposal, whose poses determine which heels are planted."""
        features = self.proposal.features(self.context.ground_pose, self.contacts)
        return self.context.build_trial(features[None], self.contacts[None])

    @cached_property
    def _smoothing_matrix(self) -> Float[Tensor, "frames frames"]:
        return gaussian.unit_variance_matrix(len(self.sigma), SMOOTH_FRAMES, self.sigma.dtype)

    def build(self, unknowns: Float[Tensor, "batch unknowns"]) -> Trial:
        """Build the trials of the proposal with the offsets added; differentiable."""
        white = torch.unflatten(unknowns, -1, self.sigma.shape)
        offset = self.sigma * torch.einsum("ts,bsw->btw", self._smoothing_matrix, white)
        pose = BodyPose.unpack(self.proposal.pack() + offset)
        features = pose.features(self.context.ground_pose, self.contacts)
        log_density = None
        if not isinstance(self.context.density, DensityEnsemble):
            log_density = self.context.density.log_prob(features, self.context.prior_state.expand(len(white)))
        contacts = self.contacts.expand(len(white), -1, -1)
        return replace(self.context.build_trial(features, contacts, white, log_density), heel_plan=self._heel_plan)
