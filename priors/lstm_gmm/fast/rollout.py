"""The fast path of the LSTM-GMM: rollouts over latent noise and their pullback on one core, float32.

Same mathematics as `LstmGmm.plan`, `rollout` and `sample` (the specification, tested to agree), in compiled
loops. A rollout is one node of torch's graph: what is built on its features and densities chains onto it by
autograd, and its gradient is the hand-written back-propagation through time.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.autograd.function import once_differentiable

from mapctl.protocols import DiscreteChoices
from priors.lstm_gmm.fast import kernels, layout
from priors.lstm_gmm.fast.layout import Array, ChoiceBuffers, Tape
from priors.lstm_gmm.network import LstmGmm, LstmState


@dataclass(frozen=True, eq=False)
class _KernelPass:
    """What one pass of the kernels leaves behind; rows beyond the batch are padding."""

    tape: Tape
    noise: Array
    choices: ChoiceBuffers
    features: Array
    density: Array


class FastRollout:
    """Rollouts of `model` with its weights as they are now, copied; later training does not reach them.

    States, noise and results are CPU tensors; the arithmetic is float32 whatever their type. A state of
    batch 1 serves any number of particles. The first use on a machine compiles for some seconds; later ones
    load the result.
    """

    def __init__(self, model: LstmGmm):
        self._config, self._layout, self._kernels = model.config, model.layout, kernels
        self._settings = layout.pack_constants(model)
        self._weights, self._biases = layout.pack_weights(model)
        self._transposed = layout.transpose_layers(self._weights)
        self._zero_bias = np.zeros(2 * len(self._weights.fc2) + self._weights.fc1.shape[1], np.float32)

    def plan(self, state: LstmState, noise: Float[Tensor, "batch frames continuous"]) -> DiscreteChoices:
        """The likeliest component and contact bits of each frame along the rollout that the noise gives."""
        return self.plan_and_rollout(state, noise)[0]

    def plan_and_rollout(
        self, state: LstmState, noise: Float[Tensor, "batch frames continuous"]
    ) -> tuple[DiscreteChoices, Float[Tensor, "batch frames size"], Float[Tensor, "batch frames"]]:
        """`plan` and the `rollout` under it in one pass, without gradient: what scoring particles needs."""
        batch, frames, _ = noise.shape
        run = self._run(state, noise, _allocate_choices(batch, frames), layout.LIKELIEST, slots=2)
        plan = DiscreteChoices(_to_tensor(run.choices.component, batch), _to_tensor(run.choices.contacts, batch))
        return plan, _to_tensor(run.features, batch).to(noise.dtype), _to_tensor(run.density, batch).to(noise.dtype)

    def rollout(
        self, state: LstmState, noise: Float[Tensor, "batch frames continuous"], plan: DiscreteChoices
    ) -> tuple[Float[Tensor, "batch frames size"], Float[Tensor, "batch frames"]]:
        """Features x = mu_k + sigma_k noise under the plan, and each frame's log density under component k.

        Differentiable, once, with respect to the noise and to the state's previous frame, h and C.
        ValueError if the plan does not fit noise and network (compiled code would read past its arrays).
        """
        self._check(plan, noise)
        batch = len(noise)
        previous = state.last_frame.expand(batch, -1)
        hidden, cell = state.hidden.expand(-1, batch, -1), state.cell.expand(-1, batch, -1)
        return _Rollout.apply(noise, previous, hidden, cell, plan, self)

    def sample(
        self, state: LstmState, frames: int, generator: torch.Generator, *, temperature: float = 1.0
    ) -> tuple[Float[Tensor, "batch frames size"], LstmState]:
        """Frames drawn one after the other (section 4.1.4): the model's in distribution, not in numbers."""
        batch, size = len(state.last_frame), self._layout.continuous
        noise = temperature * torch.randn(batch, frames, size, generator=generator)
        choices = _allocate_choices(batch, frames, torch.rand(batch, frames, 3, generator=generator))
        run = self._run(state, noise, choices, layout.SAMPLED, slots=2)
        features = _to_tensor(run.features, batch).to(state.last_frame.dtype)
        return features, self._state_after(run, features[:, -1])

    def _check(self, plan: DiscreteChoices, noise: Tensor) -> None:
        if plan.component.shape != noise.shape[:2] or plan.contacts.shape != (*noise.shape[:2], 2):
            raise ValueError(
                f"the plan is for {tuple(plan.component.shape)} particles and frames, "
                f"the noise for {tuple(noise.shape[:2])}"
            )
        if plan.component.amin() < 0 or plan.component.amax() >= self._config.components:
            raise ValueError(f"the plan names a component outside 0 to {self._config.components - 1}")

    def _run(self, state: LstmState, noise: Tensor, choices: ChoiceBuffers, source: int, *, slots: int) -> _KernelPass:
        batch, frames, continuous = noise.shape
        if continuous != self._layout.continuous:
            raise ValueError(f"noise has {continuous} values a frame, the network {self._layout.continuous}")
        rows, width = layout.pad_batch_size(batch), self._config.width
        tape = layout.allocate_tape(self._weights, slots=slots, batch=rows)
        settings, size, lanes = self._settings, self._layout.size, len(self._weights.fc2)
        tape.frame[0, :batch, :size] = (_to_array(state.last_frame) - settings.mean[:size]) / settings.std[:size]
        tape.lstm_input[0, :, :, lanes:] = 0
        tape.lstm_input[0, :, :batch, lanes : lanes + width] = _to_array(state.hidden)
        tape.cell[0] = 0
        tape.cell[0, :, :batch, :width] = _to_array(state.cell)
        run = _KernelPass(
            tape,
            _pad_rows(_to_array(noise), rows),
            ChoiceBuffers(*(_pad_rows(part, rows) for part in choices)),
            np.empty((rows, frames, size), np.float32),
            np.empty((rows, frames), np.float32),
        )
        self._kernels.forward(
            self._weights, self._biases, settings, tape, run.noise, run.choices, source, run.features, run.density
        )
        return run

    def _state_after(self, run: _KernelPass, previous: Float[Tensor, "batch size"]) -> LstmState:
        slot, batch, width = run.noise.shape[1] % len(run.tape.frame), len(previous), self._config.width
        lanes = len(self._weights.fc2)
        hidden = run.tape.lstm_input[slot, :, :batch, lanes : lanes + width]
        cell = run.tape.cell[slot, :, :batch, :width]
        return LstmState(previous, *(torch.from_numpy(part.copy()).to(previous.dtype) for part in (hidden, cell)))

    def _pullback(self, run: _KernelPass, d_features: Tensor, d_density: Tensor) -> tuple[Array, Array, Array, Array]:
        """Gradients on the noise, the previous frame (physical units), h and C."""
        batch, rows, lanes = len(d_features), len(run.noise), len(self._weights.fc2)
        width, size = self._config.width, self._layout.size
        d_noise, d_frame = np.empty_like(run.noise), np.zeros_like(run.tape.frame[0])
        d_input, d_cell = np.zeros_like(run.tape.lstm_input[0]), np.zeros_like(run.tape.cell[0])
        self._kernels.backward(
            self._weights,
            self._transposed,
            self._zero_bias,
            self._settings,
            run.tape,
            run.noise,
            run.choices.component,
            _pad_rows(_to_array(d_features), rows),
            _pad_rows(_to_array(d_density), rows),
            d_noise,
            d_frame,
            d_input,
            d_cell,
        )
        d_previous = d_frame[:batch, :size] / self._settings.std[:size]
        return (d_noise[:batch], d_previous, d_input[:, :batch, lanes : lanes + width], d_cell[:, :batch, :width])


class _Rollout(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        noise: Tensor,
        previous: Tensor,
        hidden: Tensor,
        cell: Tensor,
        plan: DiscreteChoices,
        fast: FastRollout,
    ):
        batch, frames, _ = noise.shape
        choices = ChoiceBuffers(plan.component.numpy(), plan.contacts.numpy(), _NO_UNIFORM)
        # Only a pullback needs every frame's activations; else they would but push the weights out of cache.
        slots = frames + 1 if any(ctx.needs_input_grad) else 2
        run = fast._run(LstmState(previous, hidden, cell), noise, choices, layout.GIVEN, slots=slots)
        ctx.run, ctx.fast, ctx.types = run, fast, (noise.dtype, previous.dtype, hidden.dtype, cell.dtype)
        return _to_tensor(run.features, batch).to(noise.dtype), _to_tensor(run.density, batch).to(noise.dtype)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *pulled: Tensor):  # pyright: ignore[reportIncompatibleMethodOverride]
        gradients = ctx.fast._pullback(ctx.run, *pulled)
        tensors = [torch.from_numpy(part).to(kind) for part, kind in zip(gradients, ctx.types, strict=True)]
        return *tensors, None, None


_NO_UNIFORM = np.zeros((1, 1, 3), np.float32)


def _allocate_choices(batch: int, frames: int, uniform: Tensor | None = None) -> ChoiceBuffers:
    drawn = _NO_UNIFORM if uniform is None else uniform.numpy()
    return ChoiceBuffers(np.zeros((batch, frames), np.int64), np.zeros((batch, frames, 2), np.bool_), drawn)


def _to_array(tensor: Tensor) -> Array:
    return np.ascontiguousarray(tensor.detach().to(torch.float32).numpy())


def _pad_rows(array: np.ndarray, rows: int) -> np.ndarray:
    """Contiguous, with rows of zeros up to `rows`."""
    if len(array) == rows:
        return np.ascontiguousarray(array)
    return np.concatenate([array, np.zeros((rows - len(array), *array.shape[1:]), array.dtype)])


def _to_tensor(array: np.ndarray, batch: int) -> Tensor:
    return torch.from_numpy(array[:batch])
