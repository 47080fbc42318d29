"""Learned models: what motion is natural."""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from priors.density import LstmGmmDensity
    from priors.refiner import LstmRefiner


def load(name: str) -> "LstmGmmDensity":
    """A bundled prior by name (`locomotion`), or a trained one by its file or run folder."""
    from priors import density

    return density.load(name)


def load_refiner(name: str) -> "LstmRefiner":
    """A bundled refiner by name (`locomotion-refiner`), or a trained one by its file or run folder."""
    from priors import refiner

    return refiner.load(name)


def refiner_of(prior: str) -> "LstmRefiner | None":
    """The bundled refiner of a bundled prior, if it has one."""
    from priors import checkpoints

    name = f"{prior}-refiner"
    return load_refiner(name) if name in checkpoints.bundled() else None
