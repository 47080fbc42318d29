"""Memory of the fast rollout: the network's weights packed for the kernels, and the tape of its activations.

Sizes are padded with zeros so that no loop of the kernels has a remainder: widths to multiples of 16,
particles to multiples of 4 where there are several. A padded unit stays exactly 0 and so changes nothing.
"""

import platform
from collections.abc import Sequence
from typing import Any, NamedTuple

import llvmlite.binding as llvm
import numpy as np
import torch
from llvmlite import ir
from numba import config, types
from numba.extending import intrinsic
from numpy.typing import NDArray
from torch import Tensor

from priors.lstm_gmm.network import LstmGmm


def _type_widening(typing_context: Any, value: Any) -> Any:
    if value == types.float32:
        return types.float32(types.float32), lambda context, builder, signature, given: given[0]
    if value == types.uint16:
        return types.float32(types.uint16), _convert_half
    return None


def _convert_half(context: Any, builder: Any, signature: Any, given: Sequence[Any]) -> Any:
    return builder.fpext(builder.bitcast(given[0], ir.HalfType()), ir.FloatType())


widen: Any = intrinsic(_type_widening)
"""For kernels: a weight as float32, from float32 or from the bits (uint16) of a half-precision number."""


def converts_half() -> bool:
    """Return whether the processor that kernels are compiled for converts half precision by an instruction."""
    settings: Any = config
    if settings.CPU_NAME == "generic":
        return False
    if platform.machine().lower() in ("arm64", "aarch64"):
        return True
    if settings.CPU_FEATURES is not None:
        return "+f16c" in settings.CPU_FEATURES
    return bool(llvm.get_host_cpu_features().get("f16c", False))


def is_half(weights: np.ndarray) -> bool:
    """Return whether half precision holds every weight exactly."""
    with np.errstate(over="ignore"):
        return bool(np.array_equal(weights.astype(np.float16).astype(np.float32), weights))


def to_half_bits(weights: np.ndarray) -> np.ndarray:
    """Return the bits (uint16) of the weights in half precision."""
    return weights.astype(np.float16).view(np.uint16)


Array = NDArray[np.float32]

GIVEN, LIKELIEST, SAMPLED = 0, 1, 2
"""Where a frame's component and contact bits come from: the plan, the mixture's mode, or random numbers."""

WIDTH_STEP, BATCH_STEP, ROW_STEP = 16, 4, 4
"""Multiples to which widths (one vector register of floats), particles and rows are padded."""


class Layers(NamedTuple):
    """The network's weights; transposed for the pullback; or its biases, with the last axis gone.

    Weights are float32, or uint16 where half precision holds them all (`to_half_bits`); biases are float32. Axes
    are padded: Z features, W units, H rows of the head, which are means, log sigmas, weights, contact logits.
    """

    fc1: Array
    """(W, Z)."""
    fc2: Array
    """(W, W)."""
    lstm: Array
    """(2, 4 W, 2 W): gates i, f, g, o by layer input and own hidden state."""
    fc3: Array
    """(W, W)."""
    head: Array
    """(components, H, W): each component's rows of the output layer; all repeat weights and contacts."""


class MixtureConstants(NamedTuple):
    """Numbers of the mixture's form, and where the rows of the head lie."""

    continuous: int
    """Feature values that are Gaussian; the two contact bits follow them."""
    log_sigma: int
    """First log sigma row of the head."""
    weight: int
    """First mixture weight row."""
    contact: int
    """First of the two contact rows."""
    retain: np.float32
    """Share of the current frame carried into the means."""
    clamp: np.float32
    """Clamp of the carried frame, standard deviations."""
    low: np.float32
    """Least log sigma."""
    high: np.float32
    """Greatest log sigma."""
    mean: Array
    """(Z,) of the features, physical units."""
    std: Array
    """(Z,), physical units; 1 where padded."""
    mixing: Array
    """(components, C, C): what correlates each component's Gaussian values; ones on the diagonal where nothing does."""


class Tape(NamedTuple):
    """Activations; frame t lies in slot t modulo the slots: one a frame for a pullback, else two."""

    frame: Array
    """(slots, batch, Z): normalised input of the slot's frame."""
    first: Array
    """(slots, batch, W): after fc1."""
    lstm_input: Array
    """(slots, 2, batch, 2 W): each layer's input, then its hidden state before the slot's frame."""
    cell: Array
    """(slots, 2, batch, W): before the slot's frame."""
    gates: Array
    """(slots, 2, batch, 4 W): i, f, g, o."""
    tanh_cell: Array
    """(slots, 2, batch, W): tanh of the cell after the slot's frame."""
    third: Array
    """(slots, batch, W): after fc3."""
    head: Array
    """(slots, batch, H): sigma; d log sigma / d its row; d density / d weight and contact rows."""


class ChoiceBuffers(NamedTuple):
    """The discrete choices of a rollout, and the random numbers that make them where they are drawn."""

    component: NDArray[np.int64]
    """(batch, frames)."""
    contacts: NDArray[np.bool_]
    """(batch, frames, 2)."""
    uniform: Array
    """(batch, frames, 3) in [0, 1): component, left bit, right bit; empty unless drawn."""


def round_up_to(size: int, step: int) -> int:
    """The least multiple of `step` that holds `size`."""
    return -(-size // step) * step


def pad_batch_size(batch: int) -> int:
    """Rows of a tape for this many particles; one particle has its own path through the kernels."""
    return 1 if batch == 1 else round_up_to(batch, BATCH_STEP)


def pack_constants(model: LstmGmm) -> MixtureConstants:
    """The mixture's numbers, and the rows of the head."""
    config, size = model.config, model.layout.continuous
    rows, features = round_up_to(size, ROW_STEP), round_up_to(model.layout.size, WIDTH_STEP)
    mean, std = np.zeros(features, np.float32), np.ones(features, np.float32)
    mean[: model.layout.size], std[: model.layout.size] = _to_numpy(model.mean), _to_numpy(model.std)
    low, high = np.float32(config.min_log_sigma), np.float32(config.max_log_sigma)
    alone = torch.eye(size).repeat(config.components, 1, 1)
    mixing = np.ascontiguousarray(_to_numpy(alone if model.mixing is None else model.mixing))
    return MixtureConstants(
        size,
        rows,
        2 * rows,
        2 * rows + config.components,
        np.float32(config.retain),
        np.float32(config.clamp),
        low,
        high,
        mean,
        std,
        mixing,
    )


def pack_weights(model: LstmGmm) -> Layers:
    """Padded copies of the weights: half precision where that holds them all and the processor converts it."""
    width, features = _padded_sizes(model)
    gates = [[model.lstm.get_parameter(f"weight_{kind}_l{layer}") for kind in ("ih", "hh")] for layer in range(2)]
    weights = Layers(
        fc1=_pad_matrix(_to_numpy(model.fc1.weight), width, features),
        fc2=_pad_matrix(_to_numpy(model.fc2.weight), width, width),
        lstm=np.stack(
            [np.concatenate([_pack_gates(_to_numpy(m), width, width) for m in pair], axis=1) for pair in gates]
        ),
        fc3=_pad_matrix(_to_numpy(model.fc3.weight), width, width),
        head=_pack_head(model, _to_numpy(model.out.weight), width),
    )
    if converts_half() and all(is_half(weight) for weight in weights):
        return Layers(*(to_half_bits(weight) for weight in weights))
    return weights


def pack_biases(model: LstmGmm) -> Layers:
    """Padded float32 copies of the biases."""
    width, _ = _padded_sizes(model)
    offsets = [model.lstm.get_parameter(f"bias_ih_l{k}") + model.lstm.get_parameter(f"bias_hh_l{k}") for k in range(2)]
    return Layers(
        fc1=_pad_matrix(_to_column(model.fc1.bias), width, 1)[:, 0].copy(),
        fc2=_pad_matrix(_to_column(model.fc2.bias), width, 1)[:, 0].copy(),
        lstm=np.stack([_pack_gates(_to_column(offset), width, 1)[:, 0] for offset in offsets]),
        fc3=_pad_matrix(_to_column(model.fc3.bias), width, 1)[:, 0].copy(),
        head=_pack_head(model, _to_column(model.out.bias), 1)[..., 0].copy(),
    )


def transpose_layers(weights: Layers) -> Layers:
    """Copies with the last two axes exchanged, for pullbacks of several particles at once."""
    return Layers(*(np.ascontiguousarray(weight.swapaxes(-1, -2)) for weight in weights))


def allocate_tape(weights: Layers, *, slots: int, batch: int) -> Tape:
    """An empty tape; only what no kernel writes before it is read is zeroed."""
    width, features, rows = len(weights.fc2), weights.fc1.shape[1], weights.head.shape[1]

    def empty(*shape: int) -> Array:
        return np.empty((slots, *shape), np.float32)

    return Tape(
        frame=np.zeros((slots, batch, features), np.float32),
        first=empty(batch, width),
        lstm_input=empty(2, batch, 2 * width),
        cell=empty(2, batch, width),
        gates=empty(2, batch, 4 * width),
        tanh_cell=empty(2, batch, width),
        third=empty(batch, width),
        head=empty(batch, rows),
    )


def _padded_sizes(model: LstmGmm) -> tuple[int, int]:
    """Units of a layer and features of a frame."""
    return round_up_to(model.config.width, WIDTH_STEP), round_up_to(model.layout.size, WIDTH_STEP)


def _to_numpy(tensor: Tensor) -> Array:
    return tensor.detach().to("cpu", torch.float32).numpy()


def _to_column(bias: Tensor) -> Array:
    return _to_numpy(bias)[:, None]


def _pad_matrix(matrix: Array, rows: int, columns: int) -> Array:
    return np.pad(matrix, ((0, rows - matrix.shape[0]), (0, columns - matrix.shape[1])))


def _pack_gates(matrix: Array, width: int, columns: int) -> Array:
    return np.concatenate([_pad_matrix(gate, width, columns) for gate in np.split(matrix, 4)])


def _pack_head(model: LstmGmm, matrix: Array, columns: int) -> Array:
    """(components, H, columns) of the output layer's rows: weights, means, log sigmas, contacts."""
    count, size = model.config.components, model.layout.continuous
    weight, mean, log_sigma, contact = np.split(matrix, np.cumsum([count, count * size, count * size]))
    rows = round_up_to(size, ROW_STEP)
    height = round_up_to(2 * rows + count + 2, WIDTH_STEP)
    heads = [
        np.concatenate(
            [
                _pad_matrix(m, rows, columns),
                _pad_matrix(s, rows, columns),
                _pad_matrix(weight, count, columns),
                _pad_matrix(contact, 2, columns),
            ]
        )
        for m, s in zip(np.split(mean, count), np.split(log_sigma, count), strict=True)
    ]
    return np.stack([_pad_matrix(head, height, columns) for head in heads])
