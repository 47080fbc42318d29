"""Warm starts of L-BFGS in a window: the last window's noise, the best of random draws, or a particle swarm.

A swarm over all the noise of a window (34 x 66 numbers) gained nothing over zero noise when tried. Here it searches a
few numbers that steer: the root's noise (sideways, forward, turn) at a few knots in time, linear in between.
"""

from collections.abc import Callable
from dataclasses import dataclass, field

import torch
from jaxtyping import Float
from torch import Tensor

from mapctl.features import LAYOUT
from mapctl.problem.context import WindowRequest
from mapctl.problem.latent_noise import LatentNoise
from mapctl.problem.objective import Objective
from mapctl.solver.budget import Meter
from mapctl.solver.swarm import SwarmSettings, run_best_of_samples, run_swarm

WarmStartProposal = Callable[[WindowRequest, Float[Tensor, "1 unknowns"], Meter], Float[Tensor, "1 unknowns"]]
"""(request, warm start over the whole window, meter) to the unknowns from which L-BFGS starts."""


def keep_warm_start(
    request: WindowRequest, warm: Float[Tensor, "1 unknowns"], meter: Meter
) -> Float[Tensor, "1 unknowns"]:
    """Return the warm start itself."""
    return warm


@dataclass(frozen=True)
class SteeringKnots:
    """A space of few dimensions in the noise of a window: some blocks of features at knots in time."""

    knots: int = 4
    """Number of knots, evenly spaced over the window; between them the noise is linear."""
    blocks: tuple[str, ...] = ("root_displacement_heading", "heading_change")
    """Feature blocks whose noise is searched."""
    spread: float = 0.7
    """Standard deviation of draws at each knot, in units of the noise, whose own is 1."""

    def size(self) -> int:
        """Return the number of dimensions."""
        return self.knots * len(self._columns())

    def expand(self, values: Float[Tensor, "batch size"], frames: int) -> Float[Tensor, "batch frames continuous"]:
        """Return the noise of whole windows at points of the space."""
        knots = torch.unflatten(values, -1, (self.knots, -1)).transpose(1, 2)
        dense = torch.nn.functional.interpolate(knots, size=frames, mode="linear", align_corners=True)
        noise = values.new_zeros(len(values), frames, LAYOUT.continuous)
        noise[..., self._columns()] = dense.transpose(1, 2)
        return noise

    def _columns(self) -> list[int]:
        return [i for block in self.blocks for i in range(LAYOUT.slices[block].start, LAYOUT.slices[block].stop)]


@dataclass(frozen=True, eq=False)
class _SteeredNoise:
    """A window's noise as points of the steering space around the warm start."""

    request: WindowRequest
    warm: Float[Tensor, "1 unknowns"]
    space: SteeringKnots

    def unknowns(self, points: Float[Tensor, "batch size"]) -> Float[Tensor, "batch unknowns"]:
        """Return the unknowns of whole windows."""
        noise = self.space.expand(points.to(self.warm.dtype), self.request.context.frames)
        return self.warm + noise.flatten(1)

    def energy(self, points: Float[Tensor, "batch size"]) -> Float[Tensor, " batch"]:
        """Compute the total energy of each point, nats, under a plan of its own."""
        unknowns = self.unknowns(points)
        with torch.no_grad():
            latents = LatentNoise.from_unknowns(self.request.context, unknowns)
            return Objective(latents.build, self.request.terms).energy(unknowns)


@dataclass(frozen=True)
class BestOfSamples:
    """The best of random draws in the steering space, the warm start among them."""

    count: int = 32
    """Number of draws."""
    space: SteeringKnots = SteeringKnots()
    """Space in which they are drawn."""

    def __call__(
        self, request: WindowRequest, warm: Float[Tensor, "1 unknowns"], meter: Meter
    ) -> Float[Tensor, "1 unknowns"]:
        """Return the best draw about the warm start, or that itself; the meter counts what was evaluated."""
        noise, generator = _SteeredNoise(request, warm, self.space), request.generator
        start, spread = torch.zeros(self.space.size()), self.space.spread
        found = run_best_of_samples(
            noise.energy, start=start, spread=spread, count=self.count, meter=meter, generator=generator
        )
        return noise.unknowns(found.x[None])


@dataclass(frozen=True)
class SwarmProposal:
    """A particle swarm (Wang et al. 2019, section 5.2) in the steering space, started at the warm start."""

    settings: SwarmSettings = field(default_factory=lambda: SwarmSettings(particles=16, iterations=6))
    """Number of particles and iterations."""
    space: SteeringKnots = SteeringKnots()
    """Space in which they move."""

    def __call__(
        self, request: WindowRequest, warm: Float[Tensor, "1 unknowns"], meter: Meter
    ) -> Float[Tensor, "1 unknowns"]:
        """Return the best point of the swarm, or the warm start itself; the meter counts what was evaluated."""
        noise, generator = _SteeredNoise(request, warm, self.space), request.generator
        start, spread = torch.zeros(self.space.size()), self.space.spread
        found = run_swarm(
            noise.energy, start=start, spread=spread, settings=self.settings, meter=meter, generator=generator
        )
        return noise.unknowns(found.x[None])
