"""Easing from one value to another."""

from jaxtyping import Float
from torch import Tensor


def smootherstep(share: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
    """Ease from 0 to 1 over 0 to 1, with two continuous derivatives (Perlin 2002); held beyond."""
    share = share.clamp(0, 1)
    return share**3 * (10 + share * (6 * share - 15))
