"""Energies to energies with gradients, for the minimisers of this package."""

from collections.abc import Callable

import torch
from jaxtyping import Float
from torch import Tensor


def differentiate(
    energy: Callable[[Float[Tensor, "batch n"]], Float[Tensor, " batch"]],
) -> Callable[[Tensor], tuple[Tensor, Tensor]]:
    """Return a function that gives the energies of a batch of points and their gradients (batch, n) by reverse-mode
    differentiation, both detached; the points are independent of each other.
    """

    def evaluate(points: Tensor) -> tuple[Tensor, Tensor]:
        points = points.detach().requires_grad_(True)
        energies = energy(points)
        (gradient,) = torch.autograd.grad(energies.sum(), points)
        return energies.detach(), gradient

    return evaluate
