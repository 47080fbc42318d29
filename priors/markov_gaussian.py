"""Densities that go by the last frame alone: the rest of the protocol for whoever has a mean and its sigma."""

from abc import abstractmethod

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.distributions import Normal
from torch.nn import functional

from mapctl.features import LAYOUT
from mapctl.protocols import Density, DiscreteChoices, LastFrameState

_N = LAYOUT.continuous


class MarkovGaussian(Density[LastFrameState]):
    """A density whose next frame is a Gaussian about what the last one tells, each feature by itself, and whose contact
    bits are as likely as their logits say.

    A subclass has `name`, `limits`, `initial_states` and `sigma`, and says by `expect` what the last frame tells.
    """

    sigma: Float[Tensor, " continuous"]
    """Standard deviation of each continuous feature about its mean, physical units."""

    @abstractmethod
    def expect(self, before: Float[Tensor, "*batch size"]) -> Float[Tensor, "*batch size"]:
        """Return means of the next frame's continuous features (physical units), then logits of its contact bits."""
        ...

    def start_after(self, last_frame: Float[Tensor, "batch size"]) -> LastFrameState:
        """Return the state that has seen this frame."""
        return LastFrameState(last_frame)

    def advance(self, state: LastFrameState, committed: Float[Tensor, "batch frames size"]) -> LastFrameState:
        """Return the state that has seen the last of these frames."""
        return LastFrameState(committed[:, -1])

    def log_prob(
        self,
        features: Float[Tensor, "batch frames size"],
        state: LastFrameState,
        *,
        inputs: Float[Tensor, "batch frames size"] | None = None,
    ) -> Float[Tensor, "batch frames"]:
        """Compute the log density of each frame given the one before it, contact bits included, in nats of physical
        units; where `inputs` are given, each frame is conditioned on them instead, which are not scored."""
        mean, logits = self._expect_each(features if inputs is None else inputs, state)
        bits = functional.binary_cross_entropy_with_logits(logits, features[..., _N:], reduction="none")
        return Normal(mean, self.sigma).log_prob(features[..., :_N]).sum(-1) - bits.sum(-1)

    def plan(self, state: LastFrameState, noise: Float[Tensor, "batch frames continuous"]) -> DiscreteChoices:
        """Choose the likelier contact bits of each frame along the rollout that the noise gives."""
        with torch.no_grad():
            return _choose(self._roll(state, noise, None)[..., _N:] > 0.5)

    def rollout(
        self, state: LastFrameState, noise: Float[Tensor, "batch frames continuous"], plan: DiscreteChoices
    ) -> tuple[Float[Tensor, "batch frames size"], Float[Tensor, "batch frames"]]:
        """Roll out the mean plus sigma times the noise, frame after frame, with the plan's contact bits; also return
        the log density of each frame, nats. Both are differentiable in the noise."""
        features = self._roll(state, noise, plan.contacts)
        return features, self.log_prob(features, state)

    def latents(
        self, features: Float[Tensor, "batch frames size"], state: LastFrameState
    ) -> tuple[DiscreteChoices, Float[Tensor, "batch frames continuous"]]:
        """Find the contact bits and the noise whose rollout is the features."""
        with torch.no_grad():
            noise = (features[..., :_N] - self._expect_each(features, state)[0]) / self.sigma
        return _choose(features[..., _N:] > 0.5), noise

    def _expect_each(
        self, seen: Float[Tensor, "batch frames size"], state: LastFrameState
    ) -> tuple[Float[Tensor, "batch frames continuous"], Float[Tensor, "batch frames 2"]]:
        expected = self.expect(torch.cat([state.last_frame[:, None], seen[:, :-1]], dim=1))
        return expected[..., :_N], expected[..., _N:]

    def _roll(
        self,
        state: LastFrameState,
        noise: Float[Tensor, "batch frames continuous"],
        contacts: Bool[Tensor, "batch frames 2"] | None,
    ) -> Float[Tensor, "batch frames size"]:
        """Roll out, with the likeliest contact bits unless some are given."""
        frames = [state.last_frame]
        for number, step in enumerate(noise.unbind(1)):
            expected = self.expect(frames[-1])
            bits = expected[:, _N:] > 0 if contacts is None else contacts[:, number]
            frames.append(torch.cat([expected[:, :_N] + self.sigma * step, bits.to(step)], dim=-1))
        return torch.stack(frames[1:], dim=1)


def _choose(contacts: Bool[Tensor, "batch frames 2"]) -> DiscreteChoices:
    return DiscreteChoices(torch.zeros(contacts.shape[:2], dtype=torch.long), contacts)
