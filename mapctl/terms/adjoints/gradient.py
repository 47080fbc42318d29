"""Gradient of energies on the quantities that a trial offers: every term adds its own."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mapctl.terms.trial import Trial

Array = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class TrialGradient:
    """Gradients, nats per unit of the quantity; terms add to the arrays in place."""

    features: Array
    """(batch, frames, size): on the features, beside what reaches them through the poses in the world."""
    noise: Array
    """(batch, frames, width): on the noise."""
    log_density: Array
    """(batch, frames): on the log density."""
    root_xz_world: Array
    """(batch, frames, 2): on the ground projection of the hips, beside what reaches it through the joints."""
    heading: Array
    """(batch, frames): on the heading of the hips, likewise."""
    joints_world: Array
    """(batch, frames, joints, 3): on the world joint positions."""
    heels_world: Array
    """(batch, frames, 2, 3): on the world positions of the heels."""

    @staticmethod
    def zeros(trial: Trial) -> "TrialGradient":
        """Zeros for a trial that has noise."""
        batch, frames, size = trial.features.shape
        shapes = ((size,), trial.require_noise().shape[2:], (), (2,), (), (trial.skeleton.num_joints, 3), (2, 3))
        return TrialGradient(*(np.zeros((batch, frames, *shape), np.float32) for shape in shapes))
