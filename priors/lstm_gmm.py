"""LSTM with a mixture of Gaussians over the next frame: the density of the rnn paper (section 4.1, figure 3).

FC, FC, LSTM, LSTM, FC, then five diagonal Gaussians (Eq. 6-8) and two Bernoulli contact bits (section 4.3). The paper
predicts the next frame itself; by default the network predicts a change added to a slightly shrunken copy of the
current frame, which learns faster and stays bounded in free run. `retain=0` is the paper's variant.
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from mapctl.errors import RequestError
from mapctl.features import LAYOUT, FeatureLayout
from mapctl.protocols import Plan


@dataclass(frozen=True)
class LstmGmmConfig:
    """Shape of the network."""

    width: int = 500
    """Units of every hidden layer."""
    components: int = 5
    """Gaussians in the mixture."""
    retain: float = 0.9
    """Share of the current (normalised) frame carried into the means; 0 is the paper's absolute prediction."""
    clamp: float = 5.0
    """The carried frame is clamped to this many standard deviations, which bounds free runs."""
    min_log_sigma: float = -4.6
    """Floor of the predicted log standard deviations (normalised units)."""
    max_log_sigma: float = 1.0
    """Their ceiling."""

    def __post_init__(self):
        for name in ("width", "components"):
            if getattr(self, name) < 1:
                raise RequestError(f"{name} must be at least 1, got {getattr(self, name)}")


@dataclass(frozen=True, eq=False)
class LstmState:
    """What the density has seen: the last frame and the memory of both LSTM layers."""

    previous: Float[Tensor, "batch size"]
    """Last committed frame, physical units."""
    hidden: Float[Tensor, "2 batch width"]
    """h of both layers."""
    cell: Float[Tensor, "2 batch width"]
    """C of both layers."""

    @property
    def batch(self) -> int:
        """How many independent states."""
        return self.previous.shape[0]

    def pick(self, rows: Int[Tensor, " picked"]) -> "LstmState":
        """The states of some batch rows."""
        return LstmState(self.previous[rows], self.hidden[:, rows].contiguous(), self.cell[:, rows].contiguous())

    def repeat(self, count: int) -> "LstmState":
        """A batch of one, `count` times."""
        return LstmState(self.previous.expand(count, -1), self.hidden.expand(-1, count, -1).contiguous(),
                         self.cell.expand(-1, count, -1).contiguous())  # fmt: skip


@dataclass(frozen=True, eq=False)
class Mixture:
    """Distribution of the next frame, normalised units."""

    log_weight: Float[Tensor, "*batch components"]
    """Log mixture weights, normalised to sum to one."""
    mean: Float[Tensor, "*batch components continuous"]
    """Means."""
    log_sigma: Float[Tensor, "*batch components continuous"]
    """Log standard deviations."""
    contact_logit: Float[Tensor, "*batch 2"]
    """Log odds that the left and right toe are planted."""

    def log_prob(self, target: Float[Tensor, "*batch size"]) -> Float[Tensor, "*batch"]:
        """Eq. 8 without its sign, plus the contact bits; the target is normalised, its bits are 0 or 1."""
        continuous, bits = target[..., : self.mean.shape[-1]], target[..., self.mean.shape[-1] :]
        error = (continuous.unsqueeze(-2) - self.mean) * torch.exp(-self.log_sigma)
        each = -0.5 * (error**2).sum(-1) - self.log_sigma.sum(-1) - 0.5 * math.log(2 * math.pi) * error.shape[-1]
        signed = torch.where(bits > 0.5, self.contact_logit, -self.contact_logit)
        return torch.logsumexp(self.log_weight + each, dim=-1) + nn.functional.logsigmoid(signed).sum(-1)


class LstmGmm(nn.Module):
    """The network with its normalisation inside. Features come and go in physical units."""

    mean: Tensor
    std: Tensor

    def __init__(
        self, config: LstmGmmConfig, *, mean: Float[Tensor, " size"], std: Float[Tensor, " size"],
        layout: FeatureLayout = LAYOUT,
    ):  # fmt: skip
        super().__init__()
        self.config, self.layout = config, layout
        self.register_buffer("mean", mean.clone())
        self.register_buffer("std", std.clone())
        width, outputs = config.width, config.components * (1 + 2 * layout.continuous) + 2
        self.fc1, self.fc2 = nn.Linear(layout.size, width), nn.Linear(width, width)
        self.lstm = nn.LSTM(width, width, num_layers=2, batch_first=True)
        self.fc3, self.out = nn.Linear(width, width), nn.Linear(width, outputs)

    def normalise(self, features: Float[Tensor, "*batch size"]) -> Float[Tensor, "*batch size"]:
        """Physical to normalised units; contact bits become -1 and 1, since their mean and spread are set to a half."""
        return (features - self.mean) / self.std

    def initial_state(self, previous: Float[Tensor, "batch size"]) -> LstmState:
        """A state with empty memory after one frame."""
        zero = previous.new_zeros(2, previous.shape[0], self.config.width)
        return LstmState(previous, zero, zero)

    def forward(
        self, inputs: Float[Tensor, "batch frames size"], memory: tuple[Tensor, Tensor]
    ) -> tuple[Mixture, tuple[Tensor, Tensor]]:
        """Mixtures of the frames after each input; inputs normalised, `memory` is (h, C) of both layers."""
        x = torch.relu(self.fc2(torch.relu(self.fc1(inputs))))
        x, memory = self.lstm(x, memory)
        return self._mixture(self.out(torch.relu(self.fc3(x))), inputs), memory

    def _mixture(self, output: Tensor, inputs: Tensor) -> Mixture:
        config, size = self.config, self.layout.continuous
        count = config.components
        weight, mean, log_sigma, contact = output.split([count, count * size, count * size, 2], dim=-1)
        mean, log_sigma = mean.unflatten(-1, (count, size)), log_sigma.unflatten(-1, (count, size))
        carried = config.retain * inputs[..., :size].clamp(-config.clamp, config.clamp)
        # A smooth floor and ceiling keep gradients alive where a hard clamp would stop them.
        low, high = config.min_log_sigma, config.max_log_sigma
        log_sigma = low + (high - low) * torch.sigmoid(4 * log_sigma / (high - low) - 1.0)
        return Mixture(torch.log_softmax(weight, dim=-1), mean + carried.unsqueeze(-2), log_sigma, contact)

    def log_prob(
        self, features: Float[Tensor, "batch frames size"], state: LstmState, *,
        inputs: Float[Tensor, "batch frames size"] | None = None,
    ) -> Float[Tensor, "batch frames"]:  # fmt: skip
        """Log density (nats, normalised units) of each frame given those before it (Eq. 5-8).

        `inputs` is what the network sees of the frames where that differs from them: the noisy inputs of Eq. 15.
        """
        seen = features if inputs is None else inputs
        before = torch.cat([state.previous.unsqueeze(1), seen[:, :-1]], dim=1)
        mixture, _ = self(self.normalise(before), (state.hidden, state.cell))
        return mixture.log_prob(self._target(features))

    def advance(self, state: LstmState, committed: Float[Tensor, "batch frames size"]) -> LstmState:
        """The state after the committed frames were seen."""
        before = torch.cat([state.previous.unsqueeze(1), committed[:, :-1]], dim=1)
        with torch.no_grad():
            _, (hidden, cell) = self(self.normalise(before), (state.hidden, state.cell))
        return LstmState(committed[:, -1], hidden, cell)

    def sample(
        self, state: LstmState, frames: int, generator: torch.Generator, *, temperature: float = 1.0
    ) -> tuple[Float[Tensor, "batch frames size"], LstmState]:
        """Frames drawn one after the other (section 4.1.4); temperature scales the Gaussians' spread."""
        drawn, device = [], self.mean.device
        with torch.no_grad():
            for _ in range(frames):
                mixture, state = self._step(state)
                # Random numbers come from the CPU's generator wherever the network is.
                weights = mixture.log_weight.exp().cpu()
                component = torch.multinomial(weights, 1, generator=generator)[:, 0].to(device)
                noise = temperature * torch.randn(len(weights), self.layout.continuous, generator=generator).to(device)
                odds = torch.sigmoid(mixture.contact_logit)
                bits = torch.rand(odds.shape, generator=generator).to(device) < odds
                state = LstmState(self._compose(mixture, component, noise, bits)[0], state.hidden, state.cell)
                drawn.append(state.previous)
        return torch.stack(drawn, dim=1), state

    def plan(self, state: LstmState, noise: Float[Tensor, "batch frames continuous"]) -> Plan:
        """The likeliest component and contact bits of each frame along the rollout that the noise gives."""
        components, contacts = [], []
        with torch.no_grad():
            for step in noise.unbind(1):
                mixture, state = self._step(state)
                components.append(mixture.log_weight.argmax(-1))
                contacts.append(mixture.contact_logit > 0)
                frame, _ = self._compose(mixture, components[-1], step, contacts[-1])
                state = LstmState(frame, state.hidden, state.cell)
        return Plan(torch.stack(components, 1), torch.stack(contacts, 1))

    def rollout(
        self, state: LstmState, noise: Float[Tensor, "batch frames continuous"], plan: Plan
    ) -> tuple[Float[Tensor, "batch frames size"], Float[Tensor, "batch frames"]]:
        """Features x = mu_k + sigma_k noise under the plan, and each frame's log density under component k.

        Differentiable by back-propagation through time: the specification that the fast path is tested against.
        """
        frames, densities = [], []
        for t, step in enumerate(noise.unbind(1)):
            mixture, state = self._step(state)
            frame, density = self._compose(mixture, plan.component[:, t], step, plan.contacts[:, t])
            state = LstmState(frame, state.hidden, state.cell)
            frames.append(frame)
            densities.append(density)
        return torch.stack(frames, 1), torch.stack(densities, 1)

    def _step(self, state: LstmState) -> tuple[Mixture, LstmState]:
        inputs = self.normalise(state.previous).unsqueeze(1)
        mixture, (hidden, cell) = self(inputs, (state.hidden, state.cell))
        mixture = Mixture(*(part.squeeze(1) for part in vars(mixture).values()))
        return mixture, LstmState(state.previous, hidden, cell)

    def _compose(
        self, mixture: Mixture, component: Int[Tensor, " batch"], noise: Float[Tensor, "batch continuous"],
        contacts: Bool[Tensor, "batch 2"],
    ) -> tuple[Float[Tensor, "batch size"], Float[Tensor, " batch"]]:  # fmt: skip
        """One frame (physical units) of the chosen component and bits, and its log density."""
        row = torch.arange(len(component))
        mean, log_sigma = mixture.mean[row, component], mixture.log_sigma[row, component]
        size = self.layout.continuous
        continuous = (mean + torch.exp(log_sigma) * noise) * self.std[:size] + self.mean[:size]
        density = mixture.log_weight[row, component] - log_sigma.sum(-1) - 0.5 * (noise**2).sum(-1)
        density = density - 0.5 * math.log(2 * math.pi) * size
        signed = torch.where(contacts, mixture.contact_logit, -mixture.contact_logit)
        density = density + nn.functional.logsigmoid(signed).sum(-1)
        return torch.cat([continuous, contacts.to(continuous.dtype)], dim=-1), density

    def _target(self, features: Tensor) -> Tensor:
        size = self.layout.continuous
        return torch.cat([self.normalise(features)[..., :size], features[..., size:]], dim=-1)
