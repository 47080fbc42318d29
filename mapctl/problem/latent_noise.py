"""Unknowns that are the noise of a rollout: x = mu_k + sigma_k d, components k and contact bits fixed by a plan."""

from dataclasses import dataclass, replace
from functools import cached_property

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mapctl.features import LAYOUT
from mapctl.kinematics import fast
from mapctl.problem.context import WindowContext
from mapctl.protocols import DiscreteChoices, PreparedRollout
from mapctl.terms.adjoints.gradient import TrialGradient
from mapctl.terms.trial import Trial


@dataclass(frozen=True, eq=False)
class LatentNoise:
    """Unknowns are the standard normal numbers d of a rollout, one batch row a candidate."""

    context: WindowContext
    """What is known before the window."""
    plan: DiscreteChoices
    """Components and contact bits of each frame."""

    prepared: PreparedRollout | None = None
    """Rollouts of as many candidates as the plan is for, where they are prepared already."""
    heel_plan: Trial | None = None
    """Motion whose poses say which heels are planted; None: see `holds_heels`."""
    holds_heels: bool = False
    """Whether the first trial that is built is the motion whose poses say which heels are planted; if not, each
    candidate's own do."""

    @staticmethod
    def from_unknowns(context: WindowContext, unknowns: Float[Tensor, "batch unknowns"]) -> "LatentNoise":
        """Plan the likeliest components and contact bits along the rollout of the unknowns."""
        noise = torch.unflatten(unknowns.detach(), -1, (context.frames, LAYOUT.continuous))
        return LatentNoise(context, context.prior.plan(context.expand_state(len(noise)), noise))

    @staticmethod
    def begin_search(context: WindowContext, start: Float[Tensor, "batch unknowns"]) -> "LatentNoise":
        """Plan like `from_unknowns`, for a search that evaluates the start first: its rollout is done only once."""
        noise = torch.unflatten(start.detach(), -1, (context.frames, LAYOUT.continuous))
        planned = context.prior.plan_search(context.expand_state(len(noise)), noise)
        return LatentNoise(context, *planned, holds_heels=True)

    @staticmethod
    def extend(warm_start: Float[Tensor, "ahead width"], frames: int) -> Float[Tensor, "1 unknowns"]:
        """Return the last window's noise, and zero noise (the prior's plain continuation) beyond it."""
        noise = warm_start.new_zeros(frames, LAYOUT.continuous)
        noise[: len(warm_start)] = warm_start[:frames]
        return noise.flatten().unsqueeze(0)

    def build(self, unknowns: Float[Tensor, "batch unknowns"]) -> Trial:
        """Build the trials of the noise by a rollout of the density; differentiable."""
        context = self.context
        noise = torch.unflatten(unknowns, -1, (context.frames, LAYOUT.continuous))
        plan = self._expand_plan(len(noise))
        features, log_density = context.prior.rollout(context.expand_state(len(noise)), noise, plan)
        return self._hold_heels(context.build_trial(features, plan.contacts, noise=noise, log_density=log_density))

    def build_detached(self, unknowns: Float[Tensor, "batch unknowns"]) -> Trial | None:
        """See AdjointParametrisation."""
        context, batch = self.context, len(unknowns)
        noise = torch.unflatten(unknowns.detach(), -1, (context.frames, LAYOUT.continuous))
        if not fast.is_supported(noise, context.place, context.skeleton):
            return None
        rollout, contacts = self._prepare(batch)
        features, log_density = rollout.roll_out(noise)
        poses = fast.WorldPoses.compute(features, context.place, context.skeleton)
        trial = context.build_trial(features, contacts, noise=noise, log_density=log_density)
        return self._hold_heels(replace(trial, world_poses=poses))

    def pull_back(self, trial: Trial, gradient: TrialGradient) -> Float[Tensor, "batch unknowns"]:
        """See AdjointParametrisation."""
        assert trial.world_poses is not None
        on_world = (gradient.root_xz_world, gradient.heading, gradient.joints_world, gradient.heels_world)
        d_features = gradient.features + trial.world_poses.pull_back(*on_world)
        rollout, _ = self._prepare(len(d_features))
        d_noise = rollout.pull_back(torch.as_tensor(d_features), torch.as_tensor(gradient.log_density))
        return (d_noise + torch.as_tensor(gradient.noise)).flatten(1)

    def _prepare(self, batch: int) -> tuple[PreparedRollout, Bool[Tensor, "batch frames 2"]]:
        """Prepare the rollouts of so many candidates, once, and their contacts."""
        if batch not in self._prepared:
            plan = self._expand_plan(batch)
            rollout = self.context.prior.prepare_rollout(self.context.expand_state(batch), plan)
            self._prepared[batch] = rollout, plan.contacts
        return self._prepared[batch]

    @cached_property
    def _prepared(self) -> dict[int, tuple[PreparedRollout, Bool[Tensor, "batch frames 2"]]]:
        rollout, contacts = self.prepared, self.plan.contacts
        return {} if rollout is None else {len(contacts): (rollout, contacts)}

    def _hold_heels(self, trial: Trial) -> Trial:
        """Let the planned motion say which heels are planted in a trial."""
        if self.holds_heels and not self._held:
            self._held.append(replace(trial, features=trial.features.detach(), noise=None, log_density=None))
        plan = self._held[0] if self._held else self.heel_plan
        return trial if plan is None else replace(trial, heel_plan=plan)

    @cached_property
    def _held(self) -> list[Trial]:
        """The first trial that was built, where it says which heels are planted; without a gradient."""
        return []

    def _expand_plan(self, batch: int) -> DiscreteChoices:
        return DiscreteChoices(
            self.plan.component.expand(batch, -1).contiguous(), self.plan.contacts.expand(batch, -1, -1).contiguous()
        )

    def warm_start(self, unknowns: Float[Tensor, "1 unknowns"]) -> Float[Tensor, "frames width"]:
        """Return the noise by frame."""
        return torch.unflatten(unknowns[0], -1, (self.context.frames, LAYOUT.continuous))
