"""Density selection: under which of several densities a motion is likeliest, and with what weight that one counts.

Networks normalise features by their own statistics, so log densities are compared in physical units: less the sum of
the logarithms of the standard deviations. Contact bits count the same for all.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from mapctl.errors import RequestError
from mapctl.features import LAYOUT, PRIOR_FPS, encode
from mapctl.motion import Motion
from mapctl.protocols import AnyDensity, DensityState

SELECTION_WINDOW = 96
"""Length of the windows over which a density's weight is estimated, frames: in denoising, and in a card's `windows`."""
_ANGLE_DEG, _POSITION_CM = 1.0, 0.5  # typical errors of proposals
_NON_FINITE_LOG_DENSITY = -1e6  # nats


@dataclass(frozen=True, eq=False)
class DensityChoice:
    """The density under which a motion is likeliest."""

    density: AnyDensity
    """The selected density."""
    nats: Mapping[str, float]
    """Mean log density a frame by name of the density, nats, physical units."""

    @property
    def weight(self) -> float:
        """Weight of its log density, 0 to 1: 1 while the motion is as likely as the density's own data.

        Gaussians whose errors are sqrt(T) times too large lose (T - 1) / 2 nats a value: 1 / T compensates that.
        """
        lacking = self.density.reference_log_density - self.nats[self.density.name]
        return 1.0 / (1.0 + max(0.0, lacking) / (LAYOUT.continuous / 2))


@dataclass(frozen=True)
class DensityInterval:
    """Frames of a motion that one density scored."""

    start: int
    """First frame, from 0."""
    stop: int
    """One past the last frame."""
    prior: str
    """Name of the density that scored the frames, the likeliest of those given."""
    nats: Mapping[str, float]
    """Mean log density a frame by name of the density, nats, physical units."""
    weight: float
    """Weight of its log density, 0 to 1; below 1 the motion is less likely than the density's own data."""


@dataclass(frozen=True, eq=False)
class DensityEnsemble:
    """Densities of which every window uses the likeliest; there may be none. Their states are a tuple, one for each."""

    densities: Sequence[AnyDensity]
    """Densities whose log densities can be compared (see `select_density`)."""

    def infer_state(self, features: Float[Tensor, "frames size"]) -> tuple[DensityState, ...]:
        """Infer each density's state before a motion's first frames."""
        return tuple(density.infer_state(features) for density in self.densities)

    def advance(
        self, state: DensityState | tuple[DensityState, ...], committed: Float[Tensor, "batch frames size"]
    ) -> tuple[DensityState, ...]:
        """Advance each density's state by the committed frames."""
        assert isinstance(state, tuple)
        return tuple(one.advance(before, committed) for one, before in zip(self.densities, state, strict=True))


def select_density(
    densities: Sequence[AnyDensity], features: Float[Tensor, "frames size"], states: Sequence[DensityState]
) -> DensityChoice:
    """Select the density under which features are likeliest after the densities' states; RequestError for no density.

    Densities are sharper than a proposal is accurate: to score one, take the densities of motion observed with its
    errors (`density.with_observation_noise(proposal_sigma())`).
    """
    if not densities:
        raise RequestError("no density to choose from")
    with torch.no_grad():
        nats = {
            density.name: _mean_log_density(density, features, state)
            for density, state in zip(densities, states, strict=True)
        }
    return DensityChoice(max(densities, key=lambda density: nats[density.name]), nats)


def select_density_for_motion(densities: Sequence[AnyDensity], motion: Motion) -> DensityChoice:
    """Select the density under which a canonical motion at any frame rate is likeliest, given its first frame.

    RequestError for no density; MapctlError for a motion of fewer than two frames at the priors' rate.
    """
    features = encode(motion.resample(PRIOR_FPS))[0].float()
    return select_density(densities, features[1:], [density.start_after(features[:1]) for density in densities])


def proposal_sigma() -> Float[Tensor, " continuous"]:
    """Return the typical errors of a proposal: standard deviations of the continuous features, physical units."""
    sigma = torch.full((LAYOUT.continuous,), math.radians(_ANGLE_DEG))
    for block in ("root_displacement_heading", "root_height"):
        sigma[LAYOUT.slices[block]] = _POSITION_CM / 100
    # Errors of neighbouring frames are correlated, so that of their difference is smaller.
    sigma[LAYOUT.slices["heading_change"]] /= 2
    return sigma


def to_physical_log_density(
    log_density: Float[Tensor, "*batch"], feature_std: Float[Tensor, " size"]
) -> Float[Tensor, "*batch"]:
    """Convert log densities of normalised features to physical units, nats."""
    return log_density - feature_std[: LAYOUT.continuous].log().sum()


def _mean_log_density(density: AnyDensity, features: Tensor, state: DensityState) -> float:
    """Mean log density a frame, nats, physical units; very low where it is not finite."""
    nats = float(to_physical_log_density(density.log_prob(features[None], state), density.feature_std).mean())
    return nats if math.isfinite(nats) else _NON_FINITE_LOG_DENSITY
