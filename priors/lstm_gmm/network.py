"""LSTM with a mixture of Gaussians over the next frame: the density of Wang et al. 2019 (section 4.1, figure 3).

FC, FC, LSTM, LSTM, FC, then five Gaussians (Eq. 6-8) and two Bernoulli contact bits (section 4.3). By default it
departs from the paper in three ways, each measured (docs/reference/results.md): the network predicts a change added
to a slightly shrunken copy of the current frame, which learns faster and stays bounded in free run; each component's
Gaussian is correlated, by a unit triangular factor of its own, since a planted foot needs legs that compensate the
hips; and the level of the noise on the input is an input too, so that predictions from clean input are not as wide as
from noisy input. It can also be conditioned on labels of the data (gait, style).

Frames given that toes stand where the contact bits are 1: each Gaussian conditioned on its planted toes' steps.

A Gaussian whose correlations are the same in every pose cannot know how the legs make up for the hips in this one, so
its samples slide. Given a toe's step over the floor and up, observed as zero with an error, it stays a Gaussian:
Matheron's rule (Doucet 2010, "A note on efficient conditional simulation of Gaussian distributions", Eq. 3) turns one
of its samples into one of the conditional. Steps are taken linearly about the mean; the mixture's component is the one
that was drawn without them.
"""

import copy
import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import ClassVar

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from mapctl.errors import RequestError
from mapctl.features import LAYOUT, PRIOR_FPS
from mapctl.pose import BodyPose
from mapctl.protocols import DensityState, DiscreteChoices
from mapctl.skeleton import CANONICAL, TOE_JOINTS
from priors.checkpoints import NetworkConfig, Size

_CHANGE = 2e-3  # of a feature, by which steps are differentiated
_JOINTS = LAYOUT.slices["joint_rotations"].start
_LEGS = [CANONICAL.index(side + part) for side in ("left", "right") for part in ("UpperLeg", "LowerLeg", "Foot")]
_MOVING = [*range(_JOINTS), *(_JOINTS + 3 * (joint - 1) + axis for joint in _LEGS for axis in range(3))]
"""Features that move a toe: the root's, and the rotations of the legs."""
_CHANGES = torch.zeros(1 + len(_MOVING), LAYOUT.size)
_CHANGES[torch.arange(1, 1 + len(_MOVING)), _MOVING] = _CHANGE


def condition_on_standing(
    sigma_speed: float,
    before: Float[Tensor, "batch size"],
    sample: Float[Tensor, "batch size"],
    mean: Float[Tensor, "batch continuous"],
    factor: Float[Tensor, "batch continuous continuous"],
    generator: torch.Generator,
) -> Float[Tensor, "batch size"]:
    """Turn a sample of Gaussians with a mean and a factor of the covariance (physical units) into one of them given
    the steps of toes that are planted in it and in the frame `before`. `sigma_speed` is the standard deviation of each
    coordinate of such a toe's speed, m/s."""
    planted = (LAYOUT.pick(before, "contacts") > 0.5) & (LAYOUT.pick(sample, "contacts") > 0.5)
    sigma = sigma_speed / PRIOR_FPS
    error = sigma * torch.randn(len(sample), 2, 3, generator=generator).to(sample)  # drawn whoever stands
    if not bool(planted.any()):
        return sample
    size = LAYOUT.continuous
    base = torch.cat([mean, sample[:, size:]], dim=-1)
    still = torch.cat([torch.zeros_like(before[:, :3]), before[:, 3:]], dim=-1)  # where the frame comes from
    variants = torch.cat([base[:, None] + _CHANGES.to(base), still[:, None]], dim=1)
    ground, heading = LAYOUT.pick(variants, "root_displacement_heading"), LAYOUT.pick(variants, "heading_change")
    positions = BodyPose.of_features_at(variants, ground, heading[..., 0]).joints_world()
    positions = positions[:, :, list(TOE_JOINTS)].flatten(2)
    positions, stood = positions[:, :-1], positions[:, -1]
    given = planted[..., None].expand(-1, -1, 3).flatten(1)
    jacobian = factor.new_zeros(len(sample), 6, size)
    jacobian[..., _MOVING] = ((positions[:, 1:] - positions[:, :1]) / _CHANGE).transpose(1, 2)
    jacobian = torch.where(given[..., None], jacobian, 0.0)
    step = positions[:, 0] - stood + torch.einsum("bij,bj->bi", jacobian, sample[:, :size] - mean)
    spread = jacobian @ factor  # of the steps, along the Gaussian's own axes
    covariance = spread @ spread.mT + sigma**2 * torch.eye(6).to(spread)
    miss = torch.where(given, error.flatten(1) - step, 0.0)
    change = factor @ (spread.mT @ torch.linalg.solve(covariance, miss[..., None]))
    return torch.cat([sample[:, :size] + change[..., 0], sample[:, size:]], dim=-1)


NOISE_UNIT = 0.1
"""Level of input noise (normalised units) that is 1 in the network's condition."""
CLAMP = 5.0
"""Standard deviations to which the carried frame is clamped, which bounds free runs."""
MIN_LOG_SIGMA, MAX_LOG_SIGMA = -4.6, 1.0
"""Floor and ceiling of the predicted log standard deviations (normalised units)."""


@dataclass(frozen=True)
class LstmGmmConfig(NetworkConfig):
    """Shape of the network."""

    FIXED: ClassVar = {"clamp": CLAMP, "min_log_sigma": MIN_LOG_SIGMA, "max_log_sigma": MAX_LOG_SIGMA}

    width: Size = 500
    """Units of every hidden layer."""
    components: Size = 5
    """Gaussians in the mixture."""
    retain: float = 0.9
    """Share of the current (normalised) frame carried into the means; 0 is the paper's absolute prediction."""
    correlated: bool = True
    """Whether each component has a triangular factor that correlates its values; the paper's Gaussians are diagonal."""
    knows_noise: bool = True
    """Whether the level of the noise on the input is an input of the network."""
    labels: tuple[str, ...] = ()
    """Labels on which it can be conditioned, each yes or no: `gait=run`, `style=active`."""


PAPER = LstmGmmConfig(width=500, components=5, retain=0.0, correlated=False, knows_noise=False)
"""The network of Wang et al. 2019, section 4.1."""


@dataclass(frozen=True, eq=False)
class LstmState(DensityState):
    """Memory of the density: the last frame and the state of both LSTM layers."""

    last_frame: Float[Tensor, "batch size"]
    """Last committed frame, physical units."""
    hidden: Float[Tensor, "2 batch width"]
    """h of both layers."""
    cell: Float[Tensor, "2 batch width"]
    """C of both layers."""

    def pick(self, rows: Int[Tensor, " picked"]) -> "LstmState":
        return LstmState(self.last_frame[rows], self.hidden[:, rows].contiguous(), self.cell[:, rows].contiguous())


@dataclass(frozen=True, eq=False)
class Mixture:
    """Distribution of the next frame, normalised units."""

    log_weight: Float[Tensor, "*batch components"]  # log mixture weights, normalised to sum to one
    mean: Float[Tensor, "*batch components continuous"]  # means
    log_sigma: Float[Tensor, "*batch components continuous"]  # log standard deviations
    contact_logit: Float[Tensor, "*batch 2"]  # contact logits of the left and right toe

    def log_prob(
        self,
        target: Float[Tensor, "*batch size"],
        inverse_cholesky: Float[Tensor, "components continuous continuous"],
        blur: Float[Tensor, "components continuous"] | None = None,
    ) -> Float[Tensor, "*batch"]:
        """Eq. 8 without its sign, plus the contact bits; the target is normalised, its bits are 0 or 1.

        `inverse_cholesky` is each component's inverse Cholesky factor, unit lower triangular, with determinant 1;
        `blur` is added to the variances of the decorrelated values.
        """
        continuous, bits = target[..., : self.mean.shape[-1]], target[..., self.mean.shape[-1] :]
        error = torch.einsum("kij,...kj->...ki", inverse_cholesky, continuous.unsqueeze(-2) - self.mean)
        log_sigma = self.log_sigma if blur is None else 0.5 * torch.log(torch.exp(2 * self.log_sigma) + blur)
        error = error * torch.exp(-log_sigma)
        each = -0.5 * (error**2).sum(-1) - log_sigma.sum(-1) - 0.5 * math.log(2 * math.pi) * error.shape[-1]
        signed = torch.where(bits > 0.5, self.contact_logit, -self.contact_logit)
        return torch.logsumexp(self.log_weight + each, dim=-1) + nn.functional.logsigmoid(signed).sum(-1)


class LstmGmm(nn.Module):
    """The network with its normalisation inside. Features come and go in physical units."""

    mean: Tensor
    std: Tensor
    blur: Tensor | None

    def __init__(
        self,
        config: LstmGmmConfig,
        *,
        mean: Float[Tensor, " size"] | None = None,
        std: Float[Tensor, " size"] | None = None,
    ):
        super().__init__()
        self.config = config
        self.register_buffer("mean", torch.zeros(LAYOUT.size) if mean is None else mean.clone())
        self.register_buffer("std", torch.ones(LAYOUT.size) if std is None else std.clone())
        self.register_buffer("blur", None)
        width, outputs = config.width, config.components * (1 + 2 * LAYOUT.continuous) + 2
        self.fc1, self.fc2 = nn.Linear(LAYOUT.size, width), nn.Linear(width, width)
        self.lstm = nn.LSTM(width, width, num_layers=2, batch_first=True)
        self.fc3, self.out = nn.Linear(width, width), nn.Linear(width, outputs)
        conditions = int(config.knows_noise) + len(config.labels)
        self.condition = nn.Linear(conditions, width, bias=False) if conditions else None
        square = (config.components, LAYOUT.continuous, LAYOUT.continuous)
        self.correlation = nn.Parameter(torch.zeros(square), requires_grad=config.correlated)

    @property
    def inverse_cholesky(self) -> Float[Tensor, "components continuous continuous"]:
        """Unit lower triangular factor of each component: it takes the values' correlation away."""
        return torch.tril(self.correlation, -1) + torch.eye(LAYOUT.continuous).to(self.correlation)

    @property
    def cholesky(self) -> Float[Tensor, "components continuous continuous"]:
        """Inverse of `inverse_cholesky`: it makes independent values correlated."""
        inverse = self.inverse_cholesky
        unit = torch.eye(LAYOUT.continuous).to(inverse).expand_as(inverse)
        return torch.linalg.solve_triangular(inverse, unit, upper=False, unitriangular=True)

    def conditioned_on(self, labels: Iterable[str]) -> "LstmGmm":
        """Return a copy conditioned on these labels, whose weights are this network's; its inputs are taken to be
        clean.

        RequestError for a label that the network does not know.
        """
        labels, model = tuple(labels), self._copy_with_same_weights()
        for label in labels:
            if label not in self.config.labels:
                raise RequestError(f"the prior has no label {label!r}, only {', '.join(self.config.labels) or 'none'}")
        if labels and self.condition is not None and model.fc1.bias is not None:
            known = torch.zeros(self.condition.in_features)
            known[[int(self.config.knows_noise) + self.config.labels.index(label) for label in labels]] = 1
            with torch.no_grad():
                bias = self.fc1.bias + self.condition(known.to(self.mean))
            model.fc1.bias = nn.Parameter(bias, requires_grad=self.fc1.bias.requires_grad)
        return model

    def shares_weights(self, other: "LstmGmm") -> bool:
        """Whether both are the same but for biases and the noise of observations: the weights are the same tensors."""
        ours, theirs = dict(self.named_parameters()), dict(other.named_parameters())
        same = all(ours[name] is theirs.get(name) for name in ours if not name.endswith("bias"))
        return same and self.mean is other.mean and self.std is other.std

    def _copy_with_same_weights(self) -> "LstmGmm":
        kept = [*self.parameters(), *self.buffers()]
        return copy.deepcopy(self, {id(tensor): tensor for tensor in kept})

    def with_observation_noise(self, sigma: Float[Tensor, " continuous"]) -> "LstmGmm":
        """Return a copy, of the same weights, whose `log_prob` is of motion observed with independent errors of this
        sigma (physical units).

        A sharp density hardly grades motions that are off by more than it allows. What the errors add to the correlated
        values is taken to be independent as well, so that the result is still a density.
        """
        model, size = self._copy_with_same_weights(), LAYOUT.continuous
        variance = (sigma.to(self.std) / self.std[:size]).square().expand(self.config.components, size)
        model.blur = torch.einsum("kij,kj->ki", self.inverse_cholesky.detach().square(), variance)
        return model

    def normalise(self, features: Float[Tensor, "*batch size"]) -> Float[Tensor, "*batch size"]:
        """Physical to normalised units; contact bits become -1 and 1, since their mean and spread are set to a half."""
        return (features - self.mean) / self.std

    def start_after(self, last_frame: Float[Tensor, "batch size"]) -> LstmState:
        """A state with empty memory after one frame."""
        zero = last_frame.new_zeros(2, last_frame.shape[0], self.config.width)
        return LstmState(last_frame, zero, zero)

    def forward(
        self,
        inputs: Float[Tensor, "batch frames size"],
        memory: tuple[Tensor, Tensor],
        *,
        condition: Float[Tensor, "batch conditions"] | None = None,
    ) -> tuple[Mixture, tuple[Tensor, Tensor]]:
        """Mixtures of the frames after each input; inputs normalised, `memory` is (h, C) of both layers.

        `condition` is by window the level of its noise, in units of NOISE_UNIT, then 1 for each label that holds.
        Zeros, the same as None, are clean input and no label.
        """
        x = self.fc1(inputs)
        if condition is not None and self.condition is not None:
            x = x + self.condition(condition).unsqueeze(1)
        x = torch.relu(self.fc2(torch.relu(x)))
        x, memory = self.lstm(x, memory)
        return self._mixture(self.out(torch.relu(self.fc3(x))).to(inputs.dtype), inputs), memory

    def _mixture(self, output: Tensor, inputs: Tensor) -> Mixture:
        config, size = self.config, LAYOUT.continuous
        count = config.components
        weight, mean, log_sigma, contact = output.split([count, count * size, count * size, 2], dim=-1)
        mean, log_sigma = mean.unflatten(-1, (count, size)), log_sigma.unflatten(-1, (count, size))
        carried = config.retain * inputs[..., :size].clamp(-CLAMP, CLAMP)
        # A smooth floor and ceiling keep gradients alive where a hard clamp would stop them.
        low, high = MIN_LOG_SIGMA, MAX_LOG_SIGMA
        log_sigma = low + (high - low) * torch.sigmoid(4 * log_sigma / (high - low) - 1.0)
        return Mixture(torch.log_softmax(weight, dim=-1), mean + carried.unsqueeze(-2), log_sigma, contact)

    def log_prob(self, features: Float[Tensor, "batch frames size"], state: LstmState) -> Float[Tensor, "batch frames"]:
        """Compute the log density (nats, normalised units) of each frame given those before it (Eq. 5-8)."""
        mixture, _ = self._predict(state, features)
        return mixture.log_prob(self._target(features), self.inverse_cholesky, self.blur)

    def advance(
        self,
        state: LstmState,
        committed: Float[Tensor, "batch frames size"],
        *,
        condition: Float[Tensor, "batch conditions"] | None = None,
    ) -> LstmState:
        """Return the state after the committed frames, without gradient; `condition` is as in `forward`."""
        with torch.no_grad():
            return LstmState(committed[:, -1].clone(), *self._predict(state, committed, condition)[1])

    def sample(
        self,
        state: LstmState,
        frames: int,
        generator: torch.Generator,
        *,
        temperature: float = 1.0,
        sigma_speed: float | None = None,
        condition: Float[Tensor, "batch conditions"] | None = None,
        differentiable: bool = False,
    ) -> tuple[Float[Tensor, "batch frames size"], LstmState]:
        """Draw frames one after the other (section 4.1.4); temperature scales the Gaussians' sigmas, with `sigma_speed`
        each frame is drawn given that toes stand where its bits are 1 (see `condition_on_standing`), and `condition` is
        as in `forward`. Without gradient, unless `differentiable` in the weights for the drawn components and bits."""
        drawn, device, there, size = [], self.mean.device, generator.device, LAYOUT.continuous
        with torch.set_grad_enabled(differentiable and torch.is_grad_enabled()):
            cholesky = self.cholesky
            for _ in range(frames):
                mixture, state = self._step(state, condition)
                weights = mixture.log_weight.detach().exp().to(there)
                component = torch.multinomial(weights, 1, generator=generator)[:, 0].to(device)
                noise = temperature * torch.randn(len(weights), size, generator=generator, device=there).to(device)
                planted = torch.sigmoid(mixture.contact_logit.detach())  # probability
                bits = torch.rand(planted.shape, generator=generator, device=there).to(device) < planted
                frame, _ = self._compose(mixture, component, noise, bits, cholesky)
                if sigma_speed is not None:
                    gaussian = self._find_gaussian(mixture, component, cholesky, temperature)
                    frame = condition_on_standing(sigma_speed, state.last_frame, frame, *gaussian, generator)
                state = LstmState(frame, state.hidden, state.cell)
                drawn.append(frame)
            return torch.stack(drawn, dim=1), state

    def plan(self, state: LstmState, noise: Float[Tensor, "batch frames continuous"]) -> DiscreteChoices:
        """The likeliest component and contact bits of each frame along the rollout that the noise gives."""
        components, contacts = [], []
        with torch.no_grad():
            cholesky = self.cholesky
            for step in noise.unbind(1):
                mixture, state = self._step(state)
                components.append(mixture.log_weight.argmax(-1))
                contacts.append(mixture.contact_logit > 0)
                frame, _ = self._compose(mixture, components[-1], step, contacts[-1], cholesky)
                state = LstmState(frame, state.hidden, state.cell)
        return DiscreteChoices(torch.stack(components, 1), torch.stack(contacts, 1))

    def rollout(
        self, state: LstmState, noise: Float[Tensor, "batch frames continuous"], plan: DiscreteChoices
    ) -> tuple[Float[Tensor, "batch frames size"], Float[Tensor, "batch frames"]]:
        """Features x = mu_k + R_k sigma_k noise under the plan, and each frame's log density under component k.

        R is `cholesky`. Differentiable by back-propagation through time: the specification that the fast path is tested
        against.
        """
        frames, densities, cholesky = [], [], self.cholesky
        for t, step in enumerate(noise.unbind(1)):
            mixture, state = self._step(state)
            frame, density = self._compose(mixture, plan.component[:, t], step, plan.contacts[:, t], cholesky)
            state = LstmState(frame, state.hidden, state.cell)
            frames.append(frame)
            densities.append(density)
        return torch.stack(frames, 1), torch.stack(densities, 1)

    def latents(self, features: Float[Tensor, "batch frames size"], state: LstmState) -> tuple[DiscreteChoices, Tensor]:
        """The plan and the noise (batch, frames, continuous) whose rollout is the features; inverse of `rollout`.

        Of each frame's components, the one that explains it best.
        """
        with torch.no_grad():
            mixture, _ = self._predict(state, features)
            error = self._target(features)[..., : LAYOUT.continuous].unsqueeze(-2) - mixture.mean
            error = torch.einsum("kij,...kj->...ki", self.inverse_cholesky, error)
            noise = error * torch.exp(-mixture.log_sigma)
            each = mixture.log_weight - mixture.log_sigma.sum(-1) - 0.5 * noise.square().sum(-1)
            component = each.argmax(-1)
            chosen = component[..., None, None].expand(*component.shape, 1, noise.shape[-1])
            bits = LAYOUT.pick(features, "contacts") > 0.5
            return DiscreteChoices(component, bits), noise.gather(-2, chosen)[..., 0, :]

    def _predict(
        self, state: LstmState, frames: Tensor, condition: Tensor | None = None
    ) -> tuple[Mixture, tuple[Tensor, Tensor]]:
        """Mixtures of each of the frames given those before it, and the memory before the last is seen."""
        before = torch.cat([state.last_frame.unsqueeze(1), frames[:, :-1]], dim=1)
        return self(self.normalise(before), (state.hidden, state.cell), condition=condition)

    def _step(self, state: LstmState, condition: Tensor | None = None) -> tuple[Mixture, LstmState]:
        inputs = self.normalise(state.last_frame).unsqueeze(1)
        mixture, (hidden, cell) = self(inputs, (state.hidden, state.cell), condition=condition)
        mixture = Mixture(*(part.squeeze(1) for part in vars(mixture).values()))
        return mixture, LstmState(state.last_frame, hidden, cell)

    def _compose(
        self,
        mixture: Mixture,
        component: Int[Tensor, " batch"],
        noise: Float[Tensor, "batch continuous"],
        contacts: Bool[Tensor, "batch 2"],
        cholesky: Float[Tensor, "components continuous continuous"],
    ) -> tuple[Float[Tensor, "batch size"], Float[Tensor, " batch"]]:
        """One frame (physical units) of the chosen component and bits, and its log density."""
        row = torch.arange(len(component))
        mean, log_sigma = mixture.mean[row, component], mixture.log_sigma[row, component]
        size = LAYOUT.continuous
        spread = torch.einsum("bij,bj->bi", cholesky[component], torch.exp(log_sigma) * noise)
        continuous = (mean + spread) * self.std[:size] + self.mean[:size]
        density = mixture.log_weight[row, component] - log_sigma.sum(-1) - 0.5 * (noise**2).sum(-1)
        density = density - 0.5 * math.log(2 * math.pi) * size
        signed = torch.where(contacts, mixture.contact_logit, -mixture.contact_logit)
        density = density + nn.functional.logsigmoid(signed).sum(-1)
        return torch.cat([continuous, contacts.to(continuous.dtype)], dim=-1), density

    def _find_gaussian(
        self, mixture: Mixture, component: Int[Tensor, " batch"], cholesky: Tensor, temperature: float
    ) -> tuple[Float[Tensor, "batch continuous"], Float[Tensor, "batch continuous continuous"]]:
        """Mean of the chosen components and a factor of their covariance, physical units."""
        row, size = torch.arange(len(component)), LAYOUT.continuous
        sigma = temperature * torch.exp(mixture.log_sigma[row, component])
        factor = cholesky[component] * sigma[:, None]
        mean = mixture.mean[row, component] * self.std[:size] + self.mean[:size]
        return mean, self.std[:size, None] * factor

    def _target(self, features: Tensor) -> Tensor:
        size = LAYOUT.continuous
        return torch.cat([self.normalise(features)[..., :size], features[..., size:]], dim=-1)
