"""Which of several densities a motion is likelier under, and how far any of them is to be trusted with it.

Networks normalise inside themselves, each by its own statistics, so their log densities are compared in physical units:
less the sum of the logarithms of the standard deviations of the values. Contact bits count the same for all.
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
from mapctl.protocols import Density, DensityState

SELECTION_WINDOW = 96
"""Frames over which a density's trust is told: of the windows of denoising, and of a card's `windows`."""
_ANGLE_DEG, _POSITION_CM = 1.0, 0.5  # by which proposals are typically off
_NON_FINITE_LOG_DENSITY = -1e6  # nats


@dataclass(frozen=True, eq=False)
class DensityChoice:
    """The density under which a motion is likeliest."""

    density: Density
    """One of those given."""
    nats: Mapping[str, float]
    """By name of each density, the mean log density of a frame, physical units."""

    @property
    def weight(self) -> float:
        """Share, 0 to 1, that its log density should count with: 1 while the motion is as likely as its own data.

        Gaussians whose errors are sqrt(T) times too large lose (T - 1) / 2 nats a value: 1 / T makes up for it.
        """
        lacking = self.density.reference_log_density - self.nats[self.density.name]
        return 1.0 / (1.0 + max(0.0, lacking) / (LAYOUT.continuous / 2))


@dataclass(frozen=True)
class DensityInterval:
    """What densities made of some frames."""

    start: int
    """First frame, from 0."""
    stop: int
    """One past the last."""
    prior: str
    """Name of the density that was used, the likeliest of those given."""
    nats: Mapping[str, float]
    """By name of each density, the mean log density of a frame, physical units."""
    weight: float
    """Share that its log density counted with; below 1 it was out of its depth."""


@dataclass(frozen=True, eq=False)
class DensityEnsemble:
    """Densities of which every window uses the likeliest; their states are a tuple, one for each, and none may be
    given."""

    densities: Sequence[Density]
    """The densities, their log densities comparable (see `select_density`)."""

    def infer_state(self, features: Float[Tensor, "frames size"]) -> tuple[DensityState, ...]:
        """Each density's state before a motion's first frames."""
        return tuple(density.infer_state(features) for density in self.densities)

    def advance(
        self, state: DensityState | tuple[DensityState, ...], committed: Float[Tensor, "batch frames size"]
    ) -> tuple[DensityState, ...]:
        """Each density's state after the committed frames."""
        assert isinstance(state, tuple)
        return tuple(one.advance(before, committed) for one, before in zip(self.densities, state, strict=True))

    def select(
        self, features: Float[Tensor, "frames size"], state: DensityState | tuple[DensityState, ...]
    ) -> tuple["DensityChoice", DensityState]:
        """The density under which the frames are likeliest, and its state."""
        assert isinstance(state, tuple)
        choice = select_density(self.densities, features, state)
        return choice, state[list(self.densities).index(choice.density)]


def select_density(
    densities: Sequence[Density], features: Float[Tensor, "frames size"], states: Sequence[DensityState]
) -> DensityChoice:
    """Of some densities with their states before the frames. RequestError where there are none.

    To score a proposal, give the densities its errors first (`density.with_observation_noise(proposal_sigma())`): they
    are sharper than it is right.
    """
    if not densities:
        raise RequestError("no density to choose from")
    with torch.no_grad():
        nats = {
            density.name: _mean_log_density(density, features, state)
            for density, state in zip(densities, states, strict=True)
        }
    return DensityChoice(max(densities, key=lambda density: nats[density.name]), nats)


def select_density_for_motion(densities: Sequence[Density], motion: Motion) -> DensityChoice:
    """The same of a whole canonical motion at any rate, from its first frame on.

    RequestError where there are none; MapctlError for a motion of fewer than two frames at the priors' rate.
    """
    features = encode(motion.resample(PRIOR_FPS))[0].float()
    return select_density(densities, features[1:], [density.start_after(features[:1]) for density in densities])


def proposal_sigma() -> Float[Tensor, " continuous"]:
    """What a proposal is off by: standard deviations of the continuous features, physical units."""
    found = torch.full((LAYOUT.continuous,), math.radians(_ANGLE_DEG))
    for block in ("root_displacement_heading", "root_height"):
        found[LAYOUT.slices[block]] = _POSITION_CM / 100
    # Errors of neighbouring frames go together, so their difference is smaller.
    found[LAYOUT.slices["heading_change"]] /= 2
    return found


def to_physical_log_density(
    log_density: Float[Tensor, "*batch"], feature_std: Float[Tensor, " size"]
) -> Float[Tensor, "*batch"]:
    """Log densities of normalised features in physical units."""
    return log_density - feature_std[: LAYOUT.continuous].log().sum()


def _mean_log_density(density: Density, features: Tensor, state: DensityState) -> float:
    """Mean of the frames; hopeless where it is not finite."""
    found = float(to_physical_log_density(density.log_prob(features[None], state), density.feature_std).mean())
    return found if math.isfinite(found) else _NON_FINITE_LOG_DENSITY
