"""Vectors, batched."""

from jaxtyping import Float
from torch import Tensor


def length(vectors: Float[Tensor, "*batch dims"]) -> Float[Tensor, "*batch"]:
    """Return Euclidean lengths; the gradient at length 0 is 0. Typed, as `Tensor.norm` is not."""
    return vectors.norm(dim=-1)
