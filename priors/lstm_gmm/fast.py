"""The fast path of the LSTM-GMM: rollouts over latent noise and their pullback on one core, float32.

Same mathematics as `LstmGmm.plan`, `rollout` and `sample` (the specification, tested to agree), in compiled loops. A
rollout is one node of torch's graph: what is built on its features and densities chains onto it by autograd, and its
gradient is the hand-written back-propagation through time.

A rollout cannot run its frames side by side, so every frame reads every weight once. For one particle that is a matter
of memory bandwidth, for many of arithmetic; `affine` serves both, by tiles of 4 rows by 4 particles whose 16 sums stay
in registers. It was measured as fast as BLAS for one particle and twice as fast for 8 to 32, and it has no threads to
fight with. Weights are float32, or the bits of half precision, which takes half the time. Sizes are padded with zeros,
so no loop has a remainder: widths to multiples of 16, particles to multiples of 4; a padded unit stays exactly 0. All
kernels lie in one file because compiled code kept on disk goes stale by file.
"""

import math
import platform
from collections.abc import Sequence
from functools import cached_property
from typing import Any, NamedTuple

import llvmlite.binding as llvm
import numpy as np
import torch
from jaxtyping import Float
from llvmlite import ir
from numba import config, types
from numba.extending import intrinsic
from numpy.typing import NDArray
from torch import Tensor
from torch.autograd.function import once_differentiable

from mapctl.features import LAYOUT
from mapctl.numerics.jit import make_jit_decorators
from mapctl.protocols import DiscreteChoices, PreparedRollout
from priors.lstm_gmm.network import CLAMP, MAX_LOG_SIGMA, MIN_LOG_SIGMA, LstmGmm, LstmState


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


Array = NDArray[np.float32]

GIVEN, LIKELIEST, SAMPLED = 0, 1, 2
"""Where a frame's component and contact bits come from: the plan, the mixture's mode, or random numbers."""

WIDTH_STEP, BATCH_STEP, ROW_STEP = 16, 4, 4
"""Multiples to which widths (one vector register of floats), particles and rows are padded."""


class Layers(NamedTuple):
    """The network's weights; transposed for the pullback; or its biases, with the last axis gone.

    Weights are float32, or uint16 where half precision holds them all ; biases are float32. Axes
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
    mean: Array
    """(Z,) of the features, physical units."""
    std: Array
    """(Z,), physical units; 1 where padded."""
    cholesky: Array
    """(components, C, C): what correlates each component's Gaussian values."""


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
    config, size = model.config, LAYOUT.continuous
    rows, features = round_up_to(size, ROW_STEP), round_up_to(LAYOUT.size, WIDTH_STEP)
    std = np.ones(features, np.float32)
    std[: LAYOUT.size] = _to_numpy(model.std)
    return MixtureConstants(
        continuous=size,
        log_sigma=rows,
        weight=2 * rows,
        contact=2 * rows + config.components,
        retain=np.float32(config.retain),
        mean=_pad(_to_numpy(model.mean), features),
        std=std,
        cholesky=np.ascontiguousarray(_to_numpy(model.cholesky)),
    )


def pack_weights(model: LstmGmm) -> Layers:
    """Padded copies of the weights: half precision where that holds them all and the processor converts it."""
    width, features = round_up_to(model.config.width, WIDTH_STEP), round_up_to(LAYOUT.size, WIDTH_STEP)
    gates = [[model.lstm.get_parameter(f"weight_{kind}_l{layer}") for kind in ("ih", "hh")] for layer in range(2)]
    weights = Layers(
        fc1=_pad(_to_numpy(model.fc1.weight), width, features),
        fc2=_pad(_to_numpy(model.fc2.weight), width, width),
        lstm=np.stack([np.concatenate([_pack_gates(m, width, width) for m in pair], axis=1) for pair in gates]),
        fc3=_pad(_to_numpy(model.fc3.weight), width, width),
        head=_pack_head(model, model.out.weight, width),
    )
    with np.errstate(over="ignore"):
        halves: list[Any] = [weight.astype(np.float16) for weight in weights]
    exact = all(np.array_equal(half.astype(np.float32), weight) for half, weight in zip(halves, weights, strict=True))
    return Layers(*(half.view(np.uint16) for half in halves)) if exact and converts_half() else weights


def pack_biases(model: LstmGmm) -> Layers:
    """Padded float32 copies of the biases."""
    width = round_up_to(model.config.width, WIDTH_STEP)
    offsets = [model.lstm.get_parameter(f"bias_ih_l{k}") + model.lstm.get_parameter(f"bias_hh_l{k}") for k in range(2)]
    return Layers(
        fc1=_pad(_to_numpy(model.fc1.bias), width),
        fc2=_pad(_to_numpy(model.fc2.bias), width),
        lstm=np.stack([_pack_gates(offset, width) for offset in offsets]),
        fc3=_pad(_to_numpy(model.fc3.bias), width),
        head=_pack_head(model, model.out.bias),
    )


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


def _to_numpy(tensor: Tensor) -> Array:
    return tensor.detach().to("cpu", torch.float32).numpy()


def _pad(array: Array, *shape: int) -> Array:
    return np.pad(array, [(0, size - there) for size, there in zip(shape, array.shape, strict=True)])


def _pack_gates(values: Tensor, *shape: int) -> Array:
    """Weights or biases of an LSTM layer, whose four gates are padded one by one."""
    return np.concatenate([_pad(gate, *shape) for gate in np.split(_to_numpy(values), 4)])


def _pack_head(model: LstmGmm, values: Tensor, *columns: int) -> Array:
    """(components, H, columns) of the output layer's rows: weights, means, log sigmas, contacts."""
    count, size = model.config.components, LAYOUT.continuous
    weight, mean, log_sigma, contact = np.split(_to_numpy(values), np.cumsum([count, count * size, count * size]))
    rows = round_up_to(size, ROW_STEP)
    heads = [
        np.concatenate([_pad(m, rows, *m.shape[1:]), _pad(s, rows, *s.shape[1:]), weight, contact])
        for m, s in zip(np.split(mean, count), np.split(log_sigma, count), strict=True)
    ]
    height = round_up_to(2 * rows + count + 2, WIDTH_STEP)
    return np.stack([_pad(head, height, *columns) for head in heads])


_ZERO, _HALF, _ONE, _TWO, _FOUR = (np.float32(value) for value in (0, 0.5, 1, 2, 4))
_CLAMP, _LOW, _HIGH = (np.float32(value) for value in (CLAMP, MIN_LOG_SIGMA, MAX_LOG_SIGMA))
_LOG2E, _LN2_HIGH, _LN2_LOW = np.float32(1.44269504), np.float32(0.693359375), np.float32(-2.12194440e-4)
_EXP_LOW, _EXP_HIGH = np.float32(-87.0), np.float32(88.0)
_EXP = tuple(np.float32(1 / math.factorial(k)) for k in range(8))

# Sums may be reordered and fused, which vectorises them.
_entry, _inner = make_jit_decorators("reassoc", "contract", "nsz")
_, _ordered = make_jit_decorators("contract")


@_ordered
def exp(x):
    """e^x to 2 ulp by range reduction and a Taylor polynomial: unlike libm's, it runs in vector registers."""
    x = _EXP_LOW if x < _EXP_LOW else (_EXP_HIGH if x > _EXP_HIGH else x)
    power = np.floor(x * _LOG2E + _HALF)
    rest = (x - power * _LN2_HIGH) - power * _LN2_LOW
    value = _EXP[7]
    value = value * rest + _EXP[6]
    value = value * rest + _EXP[5]
    value = value * rest + _EXP[4]
    value = value * rest + _EXP[3]
    value = value * rest + _EXP[2]
    value = value * rest + _EXP[1]
    value = value * rest + _EXP[0]
    return value * np.int32((np.int32(power) + np.int32(127)) << np.int32(23)).view(np.float32)


@_inner
def sigmoid(x):
    """Logistic function."""
    return _ONE / (_ONE + exp(-x))


@_inner
def tanh(x):
    """Hyperbolic tangent, exact at 0 (padded units rest on that)."""
    return _TWO / (_ONE + exp(-_TWO * x)) - _ONE


@_inner
def affine(weight, bias, x, out):
    """out = x weight^T + bias over the first columns of x and out; weight is (rows, columns), both padded."""
    rows, columns = weight.shape
    tiled = len(x) - len(x) % 4
    for r in range(0, rows, 4):
        w0, w1, w2, w3 = weight[r], weight[r + 1], weight[r + 2], weight[r + 3]
        for b in range(0, tiled, 4):
            x0, x1, x2, x3 = x[b], x[b + 1], x[b + 2], x[b + 3]
            a00 = a10 = a20 = a30 = bias[r]
            a01 = a11 = a21 = a31 = bias[r + 1]
            a02 = a12 = a22 = a32 = bias[r + 2]
            a03 = a13 = a23 = a33 = bias[r + 3]
            for k in range(columns):
                p0, p1, p2, p3 = widen(w0[k]), widen(w1[k]), widen(w2[k]), widen(w3[k])
                q0, q1, q2, q3 = x0[k], x1[k], x2[k], x3[k]
                a00, a01, a02, a03 = a00 + p0 * q0, a01 + p1 * q0, a02 + p2 * q0, a03 + p3 * q0
                a10, a11, a12, a13 = a10 + p0 * q1, a11 + p1 * q1, a12 + p2 * q1, a13 + p3 * q1
                a20, a21, a22, a23 = a20 + p0 * q2, a21 + p1 * q2, a22 + p2 * q2, a23 + p3 * q2
                a30, a31, a32, a33 = a30 + p0 * q3, a31 + p1 * q3, a32 + p2 * q3, a33 + p3 * q3
            out[b, r], out[b, r + 1], out[b, r + 2], out[b, r + 3] = a00, a01, a02, a03
            out[b + 1, r], out[b + 1, r + 1], out[b + 1, r + 2], out[b + 1, r + 3] = a10, a11, a12, a13
            out[b + 2, r], out[b + 2, r + 1], out[b + 2, r + 2], out[b + 2, r + 3] = a20, a21, a22, a23
            out[b + 3, r], out[b + 3, r + 1], out[b + 3, r + 2], out[b + 3, r + 3] = a30, a31, a32, a33
        for b in range(tiled, len(x)):
            xb = x[b]
            s0, s1, s2, s3 = bias[r], bias[r + 1], bias[r + 2], bias[r + 3]
            for k in range(columns):
                q, p0, p1, p2, p3 = xb[k], widen(w0[k]), widen(w1[k]), widen(w2[k]), widen(w3[k])
                s0, s1, s2, s3 = s0 + p0 * q, s1 + p1 * q, s2 + p2 * q, s3 + p3 * q
            out[b, r], out[b, r + 1], out[b, r + 2], out[b, r + 3] = s0, s1, s2, s3


@_inner
def affine_pullback(weight, transposed, nothing, gradient, out):
    """out = gradient weight over the first columns of out, from `weight` or its transposed copy.

    One particle reads the weights that its rollout has just left in cache, 8 rows at a time; for several, arithmetic
    counts, and products with the copy have more of it in registers. `nothing` is a zero bias.
    """
    rows, columns = weight.shape
    if len(gradient) > 1:
        affine(transposed, nothing, gradient, out)
        return
    d, total = gradient[0], out[0, :columns]
    for k in range(columns):
        total[k] = _ZERO
    for r in range(0, rows, 8):
        w0, w1, w2, w3 = weight[r], weight[r + 1], weight[r + 2], weight[r + 3]
        w4, w5, w6, w7 = weight[r + 4], weight[r + 5], weight[r + 6], weight[r + 7]
        d0, d1, d2, d3, d4, d5, d6, d7 = d[r], d[r + 1], d[r + 2], d[r + 3], d[r + 4], d[r + 5], d[r + 6], d[r + 7]
        for k in range(columns):
            low = (d0 * widen(w0[k]) + d1 * widen(w1[k])) + (d2 * widen(w2[k]) + d3 * widen(w3[k]))
            high = (d4 * widen(w4[k]) + d5 * widen(w5[k])) + (d6 * widen(w6[k]) + d7 * widen(w7[k]))
            total[k] += low + high


@_inner
def copy(source, target, at):
    """target[:, at:] = source. Written out: numba takes seconds to compile it as slices."""
    for b in range(len(source)):
        row, out = source[b], target[b, at : at + source.shape[1]]
        for u in range(len(row)):
            out[u] = row[u]


@_inner
def relu(x, width):
    """max(x, 0) in place over the first `width` columns; NaN stays."""
    for b in range(len(x)):
        row = x[b, :width]
        for u in range(width):
            row[u] = _ZERO if row[u] <= _ZERO else row[u]


@_inner
def relu_pullback(gradient, active, width):
    """Zero the gradient in place where the activation was zero."""
    for b in range(len(gradient)):
        row, kept = gradient[b, :width], active[b, :width]
        for u in range(width):
            row[u] = row[u] if kept[u] > _ZERO else _ZERO


@_inner
def lstm_cell(gates, before, after, tanh_cell, hidden):
    """Gates (pre-activations, replaced by activations) and old cell to new cell and hidden state."""
    width = before.shape[1]
    for b in range(len(gates)):
        row = gates[b]
        for u in range(2 * width):
            row[u] = sigmoid(row[u])
        for u in range(2 * width, 3 * width):
            row[u] = tanh(row[u])
        for u in range(3 * width, 4 * width):
            row[u] = sigmoid(row[u])
        new, old, squashed, out = after[b], before[b], tanh_cell[b], hidden[b]
        for u in range(width):
            new[u] = row[width + u] * old[u] + row[u] * row[2 * width + u]
        for u in range(width):
            squashed[u] = tanh(new[u])
        for u in range(width):
            out[u] = row[3 * width + u] * squashed[u]


@_inner
def lstm_cell_pullback(above, carry, d_cell, gates, before, tanh_cell, d_gates):
    """Gradient of the pre-activations; d_cell goes from after the frame to before it, in place.

    The hidden state's gradient is above[:, :W] (this frame's use of it) + carry[:, W:] (the next frame's).
    """
    width = before.shape[1]
    for b in range(len(gates)):
        i, f, g, o = (
            gates[b, :width],
            gates[b, width : 2 * width],
            gates[b, 2 * width : 3 * width],
            gates[b, 3 * width :],
        )
        up, later, dc, old, squashed, d = (above[b], carry[b, width:], d_cell[b], before[b], tanh_cell[b], d_gates[b])
        for u in range(width):
            d[3 * width + u] = (up[u] + later[u]) * squashed[u] * o[u] * (_ONE - o[u])
        for u in range(width):
            dc[u] += (up[u] + later[u]) * o[u] * (_ONE - squashed[u] * squashed[u])
        for u in range(width):
            d[u] = dc[u] * g[u] * i[u] * (_ONE - i[u])
        for u in range(width):
            d[width + u] = dc[u] * old[u] * f[u] * (_ONE - f[u])
        for u in range(width):
            d[2 * width + u] = dc[u] * i[u] * (_ONE - g[u] * g[u])
        for u in range(width):
            dc[u] *= f[u]


@_inner
def choose_discrete(settings, count, head, uniform, source):
    """Component and contact bits of one particle from the head's weight and contact rows."""
    weights, bits = (head[settings.weight : settings.weight + count], head[settings.contact : settings.contact + 2])
    best = 0
    for k in range(1, count):
        best = k if weights[k] > weights[best] else best
    if source == LIKELIEST:
        return best, bits[0] > _ZERO, bits[1] > _ZERO
    top, total = weights[best], _ZERO
    for k in range(count):
        total += exp(weights[k] - top)
    component, passed = 0, exp(weights[0] - top)
    while component < count - 1 and passed <= uniform[0] * total:
        component += 1
        passed += exp(weights[component] - top)
    return component, uniform[1] < sigmoid(bits[0]), uniform[2] < sigmoid(bits[1])


@_inner
def discrete_density(settings, count, head, component, contacts):
    """Log probability of a component and the contact bits; their rows of the head become its gradient."""
    weights = head[settings.weight : settings.weight + count]
    top, total, chosen = weights[0], _ZERO, weights[component]
    for k in range(1, count):
        top = weights[k] if weights[k] > top else top
    for k in range(count):
        weights[k] = exp(weights[k] - top)
        total += weights[k]
    density = chosen - top - math.log(total)
    for k in range(count):
        weights[k] = (_ONE if k == component else _ZERO) - weights[k] / total
    for side in range(2):
        sign = _ONE if contacts[side] else -_ONE
        logit = sign * head[settings.contact + side]
        # log sigmoid without overflow
        density += (logit if logit < _ZERO else _ZERO) - math.log1p(exp(-abs(logit)))
        head[settings.contact + side] = sign * sigmoid(-logit)
    return np.float32(density)


@_inner
def compose_gaussian(settings, head, before, noise, after, cholesky):
    """The next frame's Gaussian values and their log density; the head's rows become sigma and slope.

    `cholesky` is the component's (C, C) triangle; it leaves volumes, and so densities, as they are.
    """
    size = settings.continuous
    means, rows = head[:size], head[settings.log_sigma : settings.log_sigma + size]
    span, limit, density = _HIGH - _LOW, _CLAMP, _ZERO
    for j in range(size):
        carried = before[j]
        carried = -limit if carried < -limit else (limit if carried > limit else carried)
        after[j] = means[j] + settings.retain * carried
    for j in range(size):
        share = sigmoid(_FOUR * rows[j] / span - _ONE)
        log_sigma = _LOW + span * share
        means[j] = exp(log_sigma)
        rows[j] = _FOUR * share * (_ONE - share)
        density -= log_sigma + _HALF * noise[j] * noise[j]
    for j in range(size):
        row, total = cholesky[j], _ZERO
        for i in range(size):
            total += row[i] * means[i] * noise[i]
        after[j] += total
    return density - _HALF * np.float32(math.log(2 * math.pi)) * size


@_inner
def compose(weights, biases, settings, tape, now, after, noise, choices, t, source, logits, features, density):
    """Output layer of one frame: only the chosen component's slice of it is computed."""
    count, size, shared = len(weights.head), settings.continuous, settings.weight
    head, hidden, following = tape.head[now], tape.third[now], tape.frame[after]
    affine(weights.head[0, shared:], biases.head[0, shared:], hidden, logits)
    copy(logits, head, shared)
    for b in range(len(noise)):
        if source != GIVEN:
            uniform = choices.uniform[b, t] if source == SAMPLED else choices.uniform[0, 0]
            k, left, right = choose_discrete(settings, count, head[b], uniform, source)
            choices.component[b, t], choices.contacts[b, t, 0], choices.contacts[b, t, 1] = k, left, right
        k = choices.component[b, t]
        affine(weights.head[k, :shared], biases.head[k, :shared], hidden[b : b + 1], head[b : b + 1])
        discrete = discrete_density(settings, count, head[b], k, choices.contacts[b, t])
        continuous = compose_gaussian(
            settings, head[b], tape.frame[now, b], noise[b, t], following[b], settings.cholesky[k]
        )
        density[b, t] = discrete + continuous
        for j in range(size):
            features[b, t, j] = following[b, j] * settings.std[j] + settings.mean[j]
        for side in range(2):
            bit, j = _ONE if choices.contacts[b, t, side] else _ZERO, size + side
            features[b, t, j], following[b, j] = bit, (bit - settings.mean[j]) / settings.std[j]


@_entry
def forward(weights, biases, settings, tape, noise, choices, source, features, density):
    """Roll out noise (batch, frames, continuous) from slot 0 of the tape; fills features and density."""
    slots, width = len(tape.frame), len(weights.fc2)
    hidden = np.empty((2, noise.shape[0], width), np.float32)
    logits = np.empty((len(noise), weights.head.shape[1] - settings.weight), np.float32)
    for t in range(noise.shape[1]):
        now, after = t % slots, (t + 1) % slots
        inputs, onward = tape.lstm_input[now], tape.lstm_input[after]
        affine(weights.fc1, biases.fc1, tape.frame[now], tape.first[now])
        relu(tape.first[now], width)
        affine(weights.fc2, biases.fc2, tape.first[now], inputs[0])
        relu(inputs[0], width)
        for layer in range(2):
            gates = tape.gates[now, layer]
            affine(weights.lstm[layer], biases.lstm[layer], inputs[layer], gates)
            old, new = tape.cell[now, layer], tape.cell[after, layer]
            lstm_cell(gates, old, new, tape.tanh_cell[now, layer], hidden[layer])
            copy(hidden[layer], onward[layer], width)
            if layer == 0:
                copy(hidden[0], inputs[1], 0)
        affine(weights.fc3, biases.fc3, hidden[1], tape.third[now])
        relu(tape.third[now], width)
        compose(weights, biases, settings, tape, now, after, noise, choices, t, source, logits, features, density)


@_inner
def compose_pullback(settings, tape, noise, component, t, d_feature, d_density, d_frame, d_noise, d_head, d_spread):
    """Gradient on one frame to its noise, the rows of the head and (d_frame, in place) the frame before.

    `d_spread` (C,) is scratch: the gradient on sigma times noise, before the mixing.
    """
    size, first = settings.continuous, settings.log_sigma
    for b in range(len(noise)):
        head, before, gradient, d_rows = tape.head[t, b], tape.frame[t, b], d_frame[b], d_head[b]
        n, dn, df, up = noise[b, t], d_noise[b, t], d_feature[b, t], d_density[b, t]
        for j in range(size):
            d_rows[j] = gradient[j] + df[j] * settings.std[j]
        cholesky = settings.cholesky[component[b, t]]
        for i in range(size):
            d_spread[i] = _ZERO
        for j in range(size):
            row, pulled = cholesky[j], d_rows[j]
            for i in range(size):
                d_spread[i] += row[i] * pulled
        for j in range(size):
            dn[j] = d_spread[j] * head[j] - up * n[j]
        for j in range(size):
            d_rows[first + j] = (d_spread[j] * head[j] * n[j] - up) * head[first + j]
        for j in range(settings.weight, len(head)):
            d_rows[j] = up * head[j]
        for j in range(size, len(gradient)):
            gradient[j] = _ZERO
        for j in range(size):
            inside = before[j] >= -_CLAMP and before[j] <= _CLAMP
            gradient[j] = settings.retain * d_rows[j] if inside else _ZERO


@_entry
def backward(weights, transposed, nothing, settings, tape, noise, component, d_feature, d_density, d_noise):
    """Pullback of `forward` by back-propagation through time: fills d_noise.

    `transposed` is read for several particles only. `nothing` is a zero bias.
    """
    batch, width = len(noise), len(weights.fc2)
    # On the state: of the next frame's input, of both layers' inputs and hidden states, and of their cells.
    d_frame = np.zeros((batch, weights.fc1.shape[1]), np.float32)
    d_input, d_cell = np.zeros((2, batch, 2 * width), np.float32), np.zeros((2, batch, width), np.float32)
    d_head = np.zeros((batch, weights.head.shape[1]), np.float32)
    d_third, d_above = np.zeros((batch, width), np.float32), np.zeros((batch, width), np.float32)
    d_gates, d_before = np.zeros((batch, 4 * width), np.float32), np.zeros_like(d_frame)
    d_spread = np.zeros(settings.continuous, np.float32)
    for t in range(noise.shape[1] - 1, -1, -1):
        compose_pullback(settings, tape, noise, component, t, d_feature, d_density, d_frame, d_noise, d_head, d_spread)
        for b in range(batch):
            k, row = component[b, t], slice(b, b + 1)
            affine_pullback(weights.head[k], transposed.head[k], nothing, d_head[row], d_third[row])
        relu_pullback(d_third, tape.third[t], width)
        affine_pullback(weights.fc3, transposed.fc3, nothing, d_third, d_above)
        for layer in (1, 0):
            above = d_above if layer == 1 else d_input[1]
            lstm_cell_pullback(
                above,
                d_input[layer],
                d_cell[layer],
                tape.gates[t, layer],
                tape.cell[t, layer],
                tape.tanh_cell[t, layer],
                d_gates,
            )
            affine_pullback(weights.lstm[layer], transposed.lstm[layer], nothing, d_gates, d_input[layer])
        relu_pullback(d_input[0], tape.lstm_input[t, 0], width)
        affine_pullback(weights.fc2, transposed.fc2, nothing, d_input[0], d_third)
        relu_pullback(d_third, tape.first[t], width)
        affine_pullback(weights.fc1, transposed.fc1, nothing, d_third, d_before)
        for b in range(batch):
            for j in range(d_frame.shape[1]):
                d_frame[b, j] += d_before[b, j]


class FastRollout:
    """Rollouts of `model` with its weights as they are now, copied; later training does not reach them.

    States, noise and results are CPU tensors; the arithmetic is float32 whatever their type. A state of
    batch 1 serves any number of particles. The first use on a machine compiles for some seconds; later ones
    load the result.
    """

    def __init__(self, model: LstmGmm, *, relative: "FastRollout | None" = None):
        """Pack the weights; those of a `relative` are taken where its model has the same, as a conditioned copy has."""
        self._model = model
        shared = relative if relative is not None and model.shares_weights(relative._model) else None
        self.weights = pack_weights(model) if shared is None else shared.weights
        self.settings = pack_constants(model) if shared is None else shared.settings
        self.biases = pack_biases(model)
        self.zero_bias = np.zeros(2 * len(self.weights.fc2) + self.weights.fc1.shape[1], np.float32)

    @cached_property
    def transposed(self) -> Layers:
        """Weights for the pullback of several particles; most searches have but one."""
        return Layers(*(np.ascontiguousarray(weight.swapaxes(-1, -2)) for weight in self.weights))

    def plan(self, state: LstmState, noise: Float[Tensor, "batch frames continuous"]) -> DiscreteChoices:
        """The likeliest component and contact bits of each frame along the rollout that the noise gives."""
        return self.plan_window(state, noise, keeps=False)[0]

    def rollout(
        self, state: LstmState, noise: Float[Tensor, "batch frames continuous"], plan: DiscreteChoices
    ) -> tuple[Float[Tensor, "batch frames size"], Float[Tensor, "batch frames"]]:
        """Features x = mu_k + sigma_k noise under the plan, and each frame's log density under component k.

        Differentiable, once, with respect to the noise. ValueError if the plan does not fit noise and network
        (compiled code would read past its arrays).
        """
        return _Rollout.apply(noise, self.prepare(state, plan, keeps=noise.requires_grad))

    def sample(
        self, state: LstmState, frames: int, generator: torch.Generator, *, temperature: float = 1.0
    ) -> tuple[Float[Tensor, "batch frames size"], LstmState]:
        """Frames drawn one after the other (section 4.1.4): the model's in distribution, not in numbers."""
        batch = len(state.last_frame)
        noise = temperature * torch.randn(batch, frames, LAYOUT.continuous, generator=generator)
        choices = _allocate_choices(batch, frames, torch.rand(batch, frames, 3, generator=generator))
        return FastWindow(self, state, choices, batch, keeps=False).sample(noise)

    def prepare(self, state: LstmState, plan: DiscreteChoices, *, keeps: bool = True) -> "FastWindow":
        """Prepare rollouts of so many particles from one state under one plan, whose memory is used again and again;
        with a pullback if `keeps`. ValueError if the plan names a component that there is not.
        """
        batch, count = len(plan.component), self._model.config.components
        if plan.contacts.shape != (*plan.component.shape, 2):
            raise ValueError(f"a plan has components {plan.component.shape}, but contacts {plan.contacts.shape}")
        if plan.component.amin() < 0 or plan.component.amax() >= count:
            raise ValueError(f"the plan names a component outside 0 to {count - 1}")
        rows = pad_batch_size(batch)
        component, contacts = (_pad_rows(each.numpy(), rows) for each in (plan.component, plan.contacts))
        choices = ChoiceBuffers(component, contacts, _NO_UNIFORM)
        return FastWindow(self, state, choices, batch, keeps=keeps)

    def plan_window(
        self, state: LstmState, noise: Float[Tensor, "batch frames continuous"], *, keeps: bool = True
    ) -> tuple[DiscreteChoices, "FastWindow"]:
        """`plan`, and rollouts prepared under it, of which that of this noise is done already; `keeps` as `prepare`."""
        batch, frames, _ = noise.shape
        window = FastWindow(self, state, _allocate_choices(batch, frames), batch, keeps=keeps)
        return window.plan(noise), window


class FastWindow(PreparedRollout):
    """Rollouts of a window under one plan, in the same memory; rows beyond the batch are padding."""

    def __init__(self, fast: FastRollout, state: LstmState, choices: ChoiceBuffers, batch: int, *, keeps: bool = True):
        """Allocate for a batch from a state. Only a pullback needs that the tape `keeps` every frame's activations;
        else they would but push the weights out of cache."""
        self._fast, self._choices, self._batch = fast, choices, batch
        self._kind = state.last_frame.dtype
        rows, frames = choices.component.shape
        settings, self._width, lanes = fast.settings, state.hidden.shape[-1], len(fast.weights.fc2)
        self._hidden = slice(lanes, lanes + self._width)  # columns of a layer's input
        self._tape = tape = allocate_tape(fast.weights, slots=frames + 1 if keeps else 2, batch=rows)
        normalised = (_to_numpy(state.last_frame) - settings.mean[: LAYOUT.size]) / settings.std[: LAYOUT.size]
        tape.frame[0, :batch, : LAYOUT.size] = normalised
        tape.lstm_input[0, :, :, lanes:] = 0
        tape.lstm_input[0, :, :batch, self._hidden] = _to_numpy(state.hidden)
        tape.cell[0] = 0
        tape.cell[0, :, :batch, : self._width] = _to_numpy(state.cell)
        self._noise = np.zeros((rows, frames, LAYOUT.continuous), np.float32)
        self._features, self._density = (
            np.empty((rows, frames, LAYOUT.size), np.float32),
            np.empty((rows, frames), np.float32),
        )
        if keeps:
            self._d_features, self._d_density = np.zeros_like(self._features), np.zeros_like(self._density)
            self._d_noise = np.empty_like(self._noise)
        self._rolled = False

    def plan(self, noise: Float[Tensor, "batch frames continuous"]) -> DiscreteChoices:
        """Make the plan the likeliest along the rollout of this noise."""
        self._roll(noise, LIKELIEST)
        parts = (self._choices.component, self._choices.contacts)
        return DiscreteChoices(*(torch.from_numpy(part[: self._batch].copy()) for part in parts))

    def sample(
        self, noise: Float[Tensor, "batch frames continuous"]
    ) -> tuple[Float[Tensor, "batch frames size"], LstmState]:
        """Roll out with components and bits by the choices' random numbers; also return the state after it."""
        self._roll(noise, SAMPLED)
        slot, batch = noise.shape[1] % len(self._tape.frame), self._batch
        memory = (self._tape.lstm_input[slot, :, :batch, self._hidden], self._tape.cell[slot, :, :batch, : self._width])
        features = torch.from_numpy(self._features[:batch]).to(self._kind)
        return features, LstmState(
            features[:, -1].clone(), *(torch.from_numpy(part.copy()).to(self._kind) for part in memory)
        )

    def roll_out(
        self, noise: Float[Tensor, "batch frames continuous"]
    ) -> tuple[Float[Tensor, "batch frames size"], Float[Tensor, "batch frames"]]:
        batch = self._batch
        if not (self._rolled and np.array_equal(self._noise[:batch], noise.numpy())):
            self._roll(noise, GIVEN)
        found = (torch.from_numpy(part[:batch]) for part in (self._features, self._density))
        features, density = (part.to(noise.dtype, copy=True) for part in found)
        return features, density

    def _roll(self, noise: Tensor, source: int) -> None:
        wanted = self._noise[: self._batch]
        if noise.shape != wanted.shape:
            raise ValueError(f"noise of {tuple(noise.shape)} does not fit rollouts of {wanted.shape}")
        wanted[:] = _to_numpy(noise)
        fast, tape = self._fast, self._tape
        forward(
            *(fast.weights, fast.biases, fast.settings, tape, self._noise, self._choices, source),
            *(self._features, self._density),
        )
        self._rolled = True

    def pull_back(
        self, d_features: Float[Tensor, "batch frames size"], d_log_density: Float[Tensor, "batch frames"]
    ) -> Float[Tensor, "batch frames continuous"]:
        fast, batch = self._fast, self._batch
        self._d_features[:batch], self._d_density[:batch] = d_features.numpy(), d_log_density.numpy()
        transposed = fast.weights if len(self._noise) == 1 else fast.transposed
        backward(
            *(fast.weights, transposed, fast.zero_bias, fast.settings, self._tape, self._noise),
            *(self._choices.component, self._d_features, self._d_density, self._d_noise),
        )
        return torch.from_numpy(self._d_noise[:batch]).to(d_features.dtype, copy=True)


class _Rollout(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, noise: Tensor, window: FastWindow):
        ctx.window = window
        return window.roll_out(noise.detach())

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *pulled: Tensor):  # pyright: ignore[reportIncompatibleMethodOverride]
        return ctx.window.pull_back(*pulled), None


_NO_UNIFORM = np.zeros((1, 1, 3), np.float32)


def _allocate_choices(batch: int, frames: int, uniform: Tensor | None = None) -> ChoiceBuffers:
    rows = pad_batch_size(batch)
    drawn = _NO_UNIFORM if uniform is None else _pad_rows(uniform.numpy(), rows)
    return ChoiceBuffers(np.zeros((rows, frames), np.int64), np.zeros((rows, frames, 2), np.bool_), drawn)


def _pad_rows(array: np.ndarray, rows: int) -> np.ndarray:
    """Contiguous, with rows of zeros up to `rows`."""
    return np.ascontiguousarray(np.concatenate([array, np.zeros((rows - len(array), *array.shape[1:]), array.dtype)]))
