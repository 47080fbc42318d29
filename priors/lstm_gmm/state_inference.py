"""The memory that a density would have had before a motion's first frames (rnn paper, section 5.4, Eq. 26).

The paper looks for the hidden state under which the second frame is likeliest, by gradient; here it is several frames,
and the states that real motion left behind say where to look: their mean and spread are the prior of the search, the
likeliest of them its beginning.
"""

from dataclasses import dataclass, field

import torch
from jaxtyping import Float
from torch import Tensor

from mapctl.solver.budget import Budget, Meter
from mapctl.solver.gradient import differentiate
from mapctl.solver.lbfgs import LbfgsSettings, minimise
from priors.lstm_gmm.network import LstmGmm, LstmState

_MIN_STD = 0.05  # of a unit of the memory: some hardly move in the data


@dataclass(frozen=True)
class StateInferenceSettings:
    """How the state is looked for."""

    frames: int = 10
    """That are to be likely; a shorter motion gives all it has."""
    lbfgs: LbfgsSettings = field(default_factory=lambda: LbfgsSettings(max_iterations=30))
    """The search."""
    budget: Budget = field(default_factory=lambda: Budget(evaluations=40))
    """Of the search."""


def infer_lstm_state(
    model: LstmGmm,
    known: LstmState,
    features: Float[Tensor, "frames size"],
    settings: StateInferenceSettings | None = None,
) -> LstmState:
    """A state (batch of one) before `features` (physical units) that makes the first of them likely (Eq. 26).

    `known` are states that motion of the data left behind. The frame before the first is taken to be as the first.
    Never less likely, a prior of the memory included, than the best of `known`; the same input gives the same state.
    """
    settings = settings or StateInferenceSettings()
    first, wanted = features[:1], features[None, : settings.frames]
    memory = torch.cat([known.hidden, known.cell], dim=-1)
    centre, spread = memory.mean(dim=1), memory.std(dim=1, correction=0).clamp_min(_MIN_STD)

    def state_of(unknowns: Float[Tensor, "batch unknowns"]) -> LstmState:
        memory = centre[:, None] + spread[:, None] * unknowns.unflatten(-1, tuple(centre.shape)).transpose(0, 1)
        hidden, cell = memory.chunk(2, dim=-1)
        return LstmState(first.expand(len(unknowns), -1), hidden.contiguous(), cell.contiguous())

    def energy(unknowns: Float[Tensor, "batch unknowns"]) -> Float[Tensor, " batch"]:
        nats = model.log_prob(wanted.expand(len(unknowns), -1, -1), state_of(unknowns)).sum(-1)
        return 0.5 * unknowns.square().sum(-1) - nats

    with torch.no_grad():
        begun = ((memory - centre[:, None]) / spread[:, None]).transpose(0, 1).flatten(1)
        start = begun[energy(begun).argmin()][None]
    found = minimise(differentiate(energy), start, settings=settings.lbfgs, meter=Meter(settings.budget))
    return state_of(found.x)
