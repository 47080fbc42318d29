"""Layers of which there are two, the forward and the backward side's, computed in one call.

The sides share no weights; tensors have a leading axis of two, forward first.
"""

import math
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from itertools import pairwise

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.functional import elu

SIDES = 2
"""Forward and backward."""


class SidedLinear(nn.Module):
    """An affine layer a side."""

    def __init__(self, inputs: int, outputs: int):
        super().__init__()
        bound = 1 / math.sqrt(inputs)
        self.weight = nn.Parameter(torch.empty(SIDES, inputs, outputs).uniform_(-bound, bound))
        self.bias = nn.Parameter(torch.zeros(SIDES, 1, outputs))
        self._rounded: Tensor | None = None

    def forward(self, x: Float[Tensor, "2 batch inputs"]) -> Float[Tensor, "2 batch outputs"]:
        """Return the outputs of each side."""
        if self._rounded is None:
            return torch.baddbmm(self.bias, x, self.weight)
        return self.bias + torch.bmm(x.bfloat16(), self._rounded).float()

    @contextmanager
    def round_weights(self) -> Iterator[None]:
        """Multiply in bfloat16; weights are rounded once for all frames that are made meanwhile."""
        self._rounded = self.weight.bfloat16()
        try:
            yield
        finally:
            self._rounded = None


@contextmanager
def multiply_in_bfloat16(*networks: nn.Module, wanted: bool = True) -> Iterator[None]:
    """Let all such layers of these networks multiply in bfloat16 meanwhile, if it is wanted."""
    with ExitStack() as stack:
        for layer in (layer for network in networks for layer in network.modules()):
            if wanted and isinstance(layer, SidedLinear):
                stack.enter_context(layer.round_weights())
        yield


class SidedLayers(nn.Module):
    """Affine layers with ELU between them."""

    def __init__(self, *widths: int):
        super().__init__()
        self.layers = nn.ModuleList(SidedLinear(one, other) for one, other in pairwise(widths))

    def forward(self, x: Float[Tensor, "2 batch inputs"]) -> Float[Tensor, "2 batch outputs"]:
        """Return the outputs of each side."""
        for number, layer in enumerate(self.layers):
            x = layer(elu(x) if number else x)
        return x

    def shrink_last(self, share: float) -> None:
        """Shrink what the last layer makes at first."""
        with torch.no_grad():
            list(self.layers.parameters())[-2].mul_(share)


class SidedLstm(nn.Module):
    """A cell of an LSTM a side (Hochreiter and Schmidhuber 1997), its forget gate open at first."""

    def __init__(self, inputs: int, width: int):
        super().__init__()
        self.width, self.gates = width, SidedLinear(inputs + width, 4 * width)
        with torch.no_grad():
            self.gates.bias[..., width : 2 * width] = 1.0

    def forward(
        self, x: Float[Tensor, "2 batch inputs"], state: tuple[Tensor, Tensor]
    ) -> tuple[Float[Tensor, "2 batch width"], Float[Tensor, "2 batch width"]]:
        """Return the output and the cell after this frame."""
        output, cell = state
        enter, forget, leave, new = self.gates(torch.cat([x, output], dim=-1)).chunk(4, dim=-1)
        cell = torch.sigmoid(forget) * cell + torch.sigmoid(enter) * torch.tanh(new)
        return torch.sigmoid(leave) * torch.tanh(cell), cell


class SidedExperts(nn.Module):
    """Affine layers whose weights are a blend of several experts' (Zhang et al. 2018); blending what the experts make
    before each nonlinearity is the same."""

    def __init__(self, experts: int, widths: Sequence[int]):
        super().__init__()
        self.experts = experts
        self.layers = nn.ModuleList(SidedLinear(one, experts * other) for one, other in pairwise(widths))

    def forward(
        self, x: Float[Tensor, "2 batch inputs"], share: Float[Tensor, "2 batch experts"]
    ) -> Float[Tensor, "2 batch outputs"]:
        """Return the outputs of each side, for the experts' shares."""
        for number, layer in enumerate(self.layers):
            each = layer(elu(x) if number else x).unflatten(-1, (self.experts, -1))
            x = (share[..., None] * each).sum(dim=-2)
        return x

    def shrink_last(self, share: float) -> None:
        """Shrink what the last layer makes at first."""
        with torch.no_grad():
            list(self.layers.parameters())[-2].mul_(share)
