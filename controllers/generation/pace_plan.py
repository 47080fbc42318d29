"""Which paces random motion has one after the other: drawn as often as the prior's data change them.

Samples of a density go on with what they do: that somebody sets off once in a minute or two is more than a network
keeps in mind. So a density that knows paces as labels is told them, one after the other.
"""

from collections.abc import Iterator, Mapping
from itertools import repeat

import torch

from mapctl.features import PRIOR_FPS, ground_speed
from mapctl.metrics.pace_changes import find_pace
from mapctl.protocols import Density, DensityState

_WITHOUT_END = 3600 * PRIOR_FPS  # frames for which a pace lasts that the data never change


def draw_paces(
    rates: Mapping[tuple[str, str], float], first: str, generator: torch.Generator
) -> Iterator[tuple[str, int]]:
    """Draw paces one after the other, without end, and for how many frames each lasts: a Markov chain in continuous
    time, of the `rates` at which one pace (the first of a key) changes to another (the second), 1/s."""
    pace = first
    while True:
        ways = {after: rate for (before, after), rate in rates.items() if before == pace and rate > 0}
        if not ways:
            yield pace, _WITHOUT_END
            continue
        seconds = float(torch.empty(()).exponential_(sum(ways.values()), generator=generator))
        yield pace, max(1, round(seconds * PRIOR_FPS))
        pace = list(ways)[int(torch.multinomial(torch.tensor([*ways.values()]), 1, generator=generator))]


def plan_paces(prior: Density, state: DensityState, generator: torch.Generator) -> Iterator[tuple[str | None, int]]:
    """Plan which paces a prior is told after a state (batch of one), and for how many frames each, without end: from
    the pace of the state's last frame on, as often as its data change. None for a prior that knows no paces."""
    if not prior.pace_rates:
        return repeat((None, _WITHOUT_END))
    return draw_paces(prior.pace_rates, find_pace(float(ground_speed(state.last_frame))), generator)
