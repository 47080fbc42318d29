"""State inference: the memory that a density would have had before a motion's first frames (Wang et al. 2019, section
5.4, Eq. 26).

The paper finds, by gradient, the hidden state under which the second frame is likeliest. Here it is several frames, and
states after real motion guide the search: their mean and standard deviation are its prior, the likeliest its start.
"""

from dataclasses import dataclass, field

import torch
from jaxtyping import Float
from torch import Tensor

from mapctl.solver.budget import Budget, Meter
from mapctl.solver.gradient import differentiate
from mapctl.solver.lbfgs import LbfgsSettings, minimise
from priors.lstm_gmm.network import LstmGmm, LstmState

_MIN_STD = 0.05  # least standard deviation of a unit of the memory: some hardly vary in the data


@dataclass(frozen=True)
class StateInferenceSettings:
    """Settings of the search for a state."""

    frames: int = 10
    """Number of frames that are to be likely, of a motion that has as many."""
    lbfgs: LbfgsSettings = field(default_factory=lambda: LbfgsSettings(max_iterations=30))
    """Settings of L-BFGS."""
    budget: Budget = field(default_factory=lambda: Budget(evaluations=40))
    """Budget of the search."""


def infer_lstm_state(
    model: LstmGmm,
    known: LstmState,
    features: Float[Tensor, "frames size"],
    settings: StateInferenceSettings | None = None,
) -> LstmState:
    """Find a state (batch of one) before `features` (physical units) that makes the first of them likely (Eq. 26).

    `known` are states after motion of the data. The frame before the first is taken to equal the first. The result is
    never less likely, a prior of the memory included, than the best of `known`; the same input gives the same state.
    """
    settings = settings or StateInferenceSettings()
    first, wanted = features[:1], features[None, : settings.frames]
    memory = torch.cat([known.hidden, known.cell], dim=-1)
    centre, sigma = memory.mean(dim=1), memory.std(dim=1, correction=0).clamp_min(_MIN_STD)

    def state_of(unknowns: Float[Tensor, "batch unknowns"]) -> LstmState:
        memory = centre[:, None] + sigma[:, None] * unknowns.unflatten(-1, tuple(centre.shape)).transpose(0, 1)
        hidden, cell = memory.chunk(2, dim=-1)
        return LstmState(first.expand(len(unknowns), -1), hidden.contiguous(), cell.contiguous())

    def energy(unknowns: Float[Tensor, "batch unknowns"]) -> Float[Tensor, " batch"]:
        nats = model.log_prob(wanted.expand(len(unknowns), -1, -1), state_of(unknowns)).sum(-1)
        return 0.5 * unknowns.square().sum(-1) - nats

    with torch.no_grad():
        starts = ((memory - centre[:, None]) / sigma[:, None]).transpose(0, 1).flatten(1)
        start = starts[energy(starts).argmin()][None]
    found = minimise(differentiate(energy), start, settings=settings.lbfgs, meter=Meter(settings.budget))
    return state_of(found.x)
