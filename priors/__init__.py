"""Learned models: what motion is natural."""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from priors.density import LstmGmmDensity


def load(name: str) -> "LstmGmmDensity":
    """A bundled prior by name (`locomotion`), or a trained one by its file or run folder."""
    from priors import density

    return density.load(name)
