"""Where L-BFGS starts in a window: the last solution's tail, the best of random draws, or a particle swarm.

A swarm over all the noise of a window (34 x 66 numbers) gained nothing over zero noise when tried. Here it
searches a few numbers that steer: the root's noise (sideways, forward, turn) at a handful of time knots, joined
linearly.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import torch
from jaxtyping import Float
from torch import Tensor

from mapctl.features import LAYOUT
from mapctl.problem.context import WindowContext
from mapctl.problem.latent_noise import LatentNoise
from mapctl.problem.objective import Objective
from mapctl.solver.budget import Meter
from mapctl.solver.swarm import SwarmSettings, run_best_of_samples, run_swarm
from mapctl.terms.base import Term

WarmStartProposal = Callable[
    [WindowContext, Sequence[Term], Float[Tensor, "1 unknowns"], Meter, torch.Generator], Tensor
]
"""(context, terms, warm start, meter, generator) to unknowns (1, unknowns)."""


def keep_warm_start(
    context: WindowContext, terms: Sequence[Term], warm: Tensor, meter: Meter, generator: torch.Generator
) -> Tensor:
    """The warm start itself."""
    return warm


@dataclass(frozen=True)
class SteeringKnots:
    """A low-dimensional space of window noise: some blocks of features at some knots in time."""

    knots: int = 4
    """Evenly spaced over the window; between them the noise is linear."""
    blocks: tuple[str, ...] = ("root_displacement_heading", "heading_change")
    """Feature blocks whose noise is searched."""
    spread: float = 0.7
    """Standard deviation of draws at each knot."""

    def size(self) -> int:
        """How many numbers."""
        return self.knots * len(self._columns())

    def expand(self, values: Float[Tensor, "batch size"], frames: int) -> Float[Tensor, "batch frames continuous"]:
        """Noise of whole windows."""
        knots = values.unflatten(-1, (self.knots, -1)).transpose(1, 2)
        dense = torch.nn.functional.interpolate(knots, size=frames, mode="linear", align_corners=True)
        noise = values.new_zeros(len(values), frames, LAYOUT.continuous)
        noise[..., self._columns()] = dense.transpose(1, 2)
        return noise

    def _columns(self) -> list[int]:
        return [i for block in self.blocks for i in range(LAYOUT.slices[block].start, LAYOUT.slices[block].stop)]


@dataclass(frozen=True)
class BestOfSamples:
    """The best of random draws in the steering space, the warm start among them."""

    count: int = 32
    """Draws."""
    space: SteeringKnots = SteeringKnots()
    """Where they are drawn."""

    def __call__(
        self, context: WindowContext, terms: Sequence[Term], warm: Tensor, meter: Meter, generator: torch.Generator
    ) -> Tensor:
        """Propose a start; see WarmStartProposal."""
        cost, start = _steering_cost(context, terms, warm, self.space), torch.zeros(self.space.size())
        found = run_best_of_samples(
            cost, start=start, spread=self.space.spread, count=self.count, meter=meter, generator=generator
        )
        return warm + self.space.expand(found.x.to(warm.dtype)[None], context.frames).flatten(1)


@dataclass(frozen=True)
class SwarmProposal:
    """A particle swarm (rnn paper, section 5.2) in the steering space, started at the warm start."""

    settings: SwarmSettings = field(default_factory=lambda: SwarmSettings(particles=16, iterations=6))
    """Particles and iterations."""
    space: SteeringKnots = SteeringKnots()
    """Where they fly."""

    def __call__(
        self, context: WindowContext, terms: Sequence[Term], warm: Tensor, meter: Meter, generator: torch.Generator
    ) -> Tensor:
        """Propose a start; see WarmStartProposal."""
        cost, start = _steering_cost(context, terms, warm, self.space), torch.zeros(self.space.size())
        found = run_swarm(
            cost, start=start, spread=self.space.spread, settings=self.settings, meter=meter, generator=generator
        )
        return warm + self.space.expand(found.x.to(warm.dtype)[None], context.frames).flatten(1)


def _steering_cost(
    context: WindowContext, terms: Sequence[Term], warm: Tensor, space: SteeringKnots
) -> Callable[[Tensor], Tensor]:
    """Energy of many points of the steering space around the warm start; every point has its own plan."""

    def cost(points: Float[Tensor, "batch size"]) -> Float[Tensor, " batch"]:
        unknowns = warm + space.expand(points.to(warm.dtype), context.frames).flatten(1)
        with torch.no_grad():
            return Objective(LatentNoise.from_unknowns(context, unknowns).build, terms).energy(unknowns)

    return cost
