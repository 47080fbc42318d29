"""The fast path of the LSTM-GMM: rollouts over latent noise and their pullback on one core, float32.

Same mathematics as `LstmGmm.plan`, `rollout` and `sample` (the specification, tested to agree), in compiled
loops. A rollout is one node of torch's graph: what is built on its features and densities chains onto it by
autograd, and its gradient is the hand-written back-propagation through time.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.autograd.function import once_differentiable

from mapctl.protocols import DiscreteChoices, PreparedRollout
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

    def __init__(self, model: LstmGmm, *, relative: "FastRollout | None" = None):
        """Pack the weights; those of a `relative` are taken where its model has the same, as a conditioned copy has."""
        self._model, self._kernels = model, kernels
        self._config, self._layout = model.config, model.layout
        shared = relative if relative is not None and model.shares_weights(relative._model) else None
        self._weights = layout.pack_weights(model) if shared is None else shared._weights
        self._settings = layout.pack_constants(model) if shared is None else shared._settings
        self._biases = layout.pack_biases(model)
        self._zero_bias = np.zeros(2 * len(self._weights.fc2) + self._weights.fc1.shape[1], np.float32)

    @cached_property
    def _transposed(self) -> layout.Layers:
        """Weights for the pullback of several particles; most searches have but one."""
        return layout.transpose_layers(self._weights)

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
        if plan.component.shape != noise.shape[:2] or plan.contacts.shape != (*noise.shape[:2], 2):
            raise ValueError(
                f"the plan is for {tuple(plan.component.shape)} particles and frames, "
                f"the noise for {tuple(noise.shape[:2])}"
            )
        self._check_components(plan)
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

    def _check_components(self, plan: DiscreteChoices) -> None:
        if plan.component.amin() < 0 or plan.component.amax() >= self._config.components:
            raise ValueError(f"the plan names a component outside 0 to {self._config.components - 1}")

    def prepare(self, state: LstmState, plan: DiscreteChoices) -> "FastWindow":
        """Prepare rollouts of so many particles from one state under one plan, whose memory is used again and again.

        ValueError if the plan names a component that there is not.
        """
        self._check_components(plan)
        batch, frames = plan.component.shape
        rows = layout.pad_batch_size(batch)
        choices = ChoiceBuffers(*(_pad_rows(part, rows) for part in _plan_buffers(plan)))
        return FastWindow(self, state, choices, (batch, frames))

    def plan_window(
        self, state: LstmState, noise: Float[Tensor, "batch frames continuous"]
    ) -> tuple[DiscreteChoices, "FastWindow"]:
        """`plan`, and rollouts prepared under it, of which that of this noise is done already."""
        batch, frames, _ = noise.shape
        window = FastWindow(self, state, _allocate_choices(layout.pad_batch_size(batch), frames), (batch, frames))
        return window.plan(noise), window

    def _run(self, state: LstmState, noise: Tensor, choices: ChoiceBuffers, source: int, *, slots: int) -> _KernelPass:
        batch, frames, continuous = noise.shape
        if continuous != self._layout.continuous:
            raise ValueError(f"noise has {continuous} values a frame, the network {self._layout.continuous}")
        rows = layout.pad_batch_size(batch)
        run = _KernelPass(
            self._begin_tape(state, slots=slots, batch=batch),
            _pad_rows(_to_array(noise), rows),
            ChoiceBuffers(*(_pad_rows(part, rows) for part in choices)),
            np.empty((rows, frames, self._layout.size), np.float32),
            np.empty((rows, frames), np.float32),
        )
        self._roll(run, source)
        return run

    def _begin_tape(self, state: LstmState, *, slots: int, batch: int) -> Tape:
        """A tape that begins in a state."""
        width, size, settings, lanes = self._config.width, self._layout.size, self._settings, len(self._weights.fc2)
        tape = layout.allocate_tape(self._weights, slots=slots, batch=layout.pad_batch_size(batch))
        tape.frame[0, :batch, :size] = (_to_array(state.last_frame) - settings.mean[:size]) / settings.std[:size]
        tape.lstm_input[0, :, :, lanes:] = 0
        tape.lstm_input[0, :, :batch, lanes : lanes + width] = _to_array(state.hidden)
        tape.cell[0] = 0
        tape.cell[0, :, :batch, :width] = _to_array(state.cell)
        return tape

    def _roll(self, run: _KernelPass, source: int) -> None:
        self._kernels.forward(
            self._weights,
            self._biases,
            self._settings,
            run.tape,
            run.noise,
            run.choices,
            source,
            run.features,
            run.density,
        )

    def _state_after(self, run: _KernelPass, previous: Float[Tensor, "batch size"]) -> LstmState:
        slot, batch, width = run.noise.shape[1] % len(run.tape.frame), len(previous), self._config.width
        lanes = len(self._weights.fc2)
        hidden = run.tape.lstm_input[slot, :, :batch, lanes : lanes + width]
        cell = run.tape.cell[slot, :, :batch, :width]
        return LstmState(previous, *(torch.from_numpy(part.copy()).to(previous.dtype) for part in (hidden, cell)))

    def _pull_back(self, run: _KernelPass, d_features: Tensor, d_density: Tensor) -> tuple[Array, Array, Array, Array]:
        """Gradients on the noise, the previous frame (physical units), h and C."""
        batch, rows, lanes = len(d_features), len(run.noise), len(self._weights.fc2)
        width, size = self._config.width, self._layout.size
        pulled = (_pad_rows(_to_array(d_features), rows), _pad_rows(_to_array(d_density), rows))
        d_noise = np.empty_like(run.noise)
        d_frame, d_input, d_cell = self._unroll(run, *pulled, d_noise)
        d_previous = d_frame[:batch, :size] / self._settings.std[:size]
        return (d_noise[:batch], d_previous, d_input[:, :batch, lanes : lanes + width], d_cell[:, :batch, :width])

    def _unroll(
        self, run: _KernelPass, d_features: Array, d_density: Array, d_noise: Array
    ) -> tuple[Array, Array, Array]:
        """Fill d_noise; return the gradients on the first slot of the tape."""
        on_state = (run.tape.frame[0], run.tape.lstm_input[0], run.tape.cell[0])
        d_frame, d_input, d_cell = (np.zeros_like(part) for part in on_state)
        self._kernels.backward(
            self._weights,
            self._weights if len(run.noise) == 1 else self._transposed,
            self._zero_bias,
            self._settings,
            run.tape,
            run.noise,
            run.choices.component,
            d_features,
            d_density,
            d_noise,
            d_frame,
            d_input,
            d_cell,
        )
        return d_frame, d_input, d_cell


class FastWindow(PreparedRollout):
    """Rollouts of a window under one plan, one after the other, in the same memory."""

    def __init__(self, fast: FastRollout, state: LstmState, choices: ChoiceBuffers, shape: tuple[int, int]):
        """Allocate for `shape`, particles and frames."""
        self._fast, self._batch = fast, shape[0]
        rows, frames, size = layout.pad_batch_size(shape[0]), shape[1], fast._layout.size
        self._run = _KernelPass(
            fast._begin_tape(state, slots=frames + 1, batch=shape[0]),
            np.zeros((rows, frames, fast._layout.continuous), np.float32),
            choices,
            np.empty((rows, frames, size), np.float32),
            np.empty((rows, frames), np.float32),
        )
        self._pulled = (np.zeros((rows, frames, size), np.float32), np.zeros((rows, frames), np.float32))
        self._d_noise = np.empty_like(self._run.noise)
        self._rolled = False

    def plan(self, noise: Float[Tensor, "batch frames continuous"]) -> DiscreteChoices:
        """Make the plan the likeliest along the rollout of this noise."""
        self._roll(noise, layout.LIKELIEST)
        parts = (self._run.choices.component, self._run.choices.contacts)
        return DiscreteChoices(*(_to_tensor(part, self._batch).clone() for part in parts))

    def roll_out(
        self, noise: Float[Tensor, "batch frames continuous"]
    ) -> tuple[Float[Tensor, "batch frames size"], Float[Tensor, "batch frames"]]:
        """See PreparedRollout."""
        run, batch = self._run, self._batch
        if not (self._rolled and np.array_equal(run.noise[:batch], noise.numpy())):
            self._roll(noise, layout.GIVEN)
        return _to_tensor(run.features, batch).to(noise.dtype, copy=True), _to_tensor(run.density, batch).to(
            noise.dtype, copy=True
        )

    def _roll(self, noise: Tensor, source: int) -> None:
        self._run.noise[: self._batch] = _to_array(noise)
        self._fast._roll(self._run, source)
        self._rolled = True

    def pull_back(
        self, d_features: Float[Tensor, "batch frames size"], d_log_density: Float[Tensor, "batch frames"]
    ) -> Float[Tensor, "batch frames continuous"]:
        """See PreparedRollout."""
        for pulled, given in zip(self._pulled, (d_features, d_log_density), strict=True):
            pulled[: self._batch] = given.numpy()
        self._fast._unroll(self._run, *self._pulled, self._d_noise)
        return _to_tensor(self._d_noise, self._batch).to(d_features.dtype, copy=True)


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
        choices = _plan_buffers(plan)
        # Only a pullback needs every frame's activations; else they would but push the weights out of cache.
        slots = frames + 1 if any(ctx.needs_input_grad) else 2
        run = fast._run(LstmState(previous, hidden, cell), noise, choices, layout.GIVEN, slots=slots)
        ctx.run, ctx.fast, ctx.types = run, fast, (noise.dtype, previous.dtype, hidden.dtype, cell.dtype)
        return _to_tensor(run.features, batch).to(noise.dtype), _to_tensor(run.density, batch).to(noise.dtype)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *pulled: Tensor):  # pyright: ignore[reportIncompatibleMethodOverride]
        gradients = ctx.fast._pull_back(ctx.run, *pulled)
        tensors = [torch.from_numpy(part).to(kind) for part, kind in zip(gradients, ctx.types, strict=True)]
        return *tensors, None, None


_NO_UNIFORM = np.zeros((1, 1, 3), np.float32)


def _plan_buffers(plan: DiscreteChoices) -> ChoiceBuffers:
    return ChoiceBuffers(plan.component.numpy(), plan.contacts.numpy(), _NO_UNIFORM)


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
