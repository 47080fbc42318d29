"""Measures of a predicted trajectory of the hips: errors after so many frames (Zhou et al. 2020, table 2)."""

from collections.abc import Sequence

from jaxtyping import Float
from torch import Tensor

SPANS = (1, 2, 4, 8, 16, 32, 64)
"""Frames at the prior's rate after which displacements are compared: V1 to V64, the paper's V2 to V128 in time."""


def compute_displacement_errors(
    predicted_xz: Float[Tensor, "*batch frames 2"], true_xz: Float[Tensor, "*batch frames 2"], span: int
) -> Float[Tensor, "*batch spans"]:
    """Compute for every frame how far the predicted displacement from it over `span` frames is from the true one,
    metres; nothing where there are not as many frames.

    Smooth at 0, so that it may be minimised: under 0.1 mm it is not exact.
    """
    apart = predicted_xz - true_xz
    return (apart[..., span:, :] - apart[..., :-span, :]).square().sum(dim=-1).add(1e-8).sqrt()


def average_displacement_errors(
    predicted_xz: Float[Tensor, "frames 2"], true_xz: Float[Tensor, "frames 2"], spans: Sequence[int] = SPANS
) -> dict[str, float]:
    """Average them over a clip by the name of the span, `V1` and so on, cm; spans that it is too short for are left
    out."""
    return {
        f"V{span}": 100 * float(compute_displacement_errors(predicted_xz, true_xz, span).mean())
        for span in spans
        if span < len(true_xz)
    }
