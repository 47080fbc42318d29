"""Which paces random motion has one after the other: drawn as often as the prior's data change them.

Samples of a density go on with what they do: that somebody sets off once in a minute or two is more than a network
keeps in mind. So a density that knows paces as labels is told them, one after the other.
"""

from collections import deque
from collections.abc import Iterator, Mapping

import torch
from jaxtyping import Float
from torch import Tensor

from mapctl.features import LAYOUT, PRIOR_FPS
from mapctl.metrics.pace_changes import find_pace, label_pace
from mapctl.protocols import Density

_LOOK = 20  # frames after which is looked whether a pace has been taken on
# Times that a label is told at once; a run that is told more often flings its legs.
_MOST_EMPHATIC = {"stand": 4, "walk": 4, "run": 2}
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


class PacePlan:
    """Tells a prior paces one after the other, and the more emphatically the longer it does not take one on.

    A label is a bias of the network's: told twice, it counts twice. Once it has the pace, telling it once suffices.
    """

    def __init__(self, prior: Density, paces: Iterator[tuple[str, int]]):
        """`paces` and for how many frames each lasts, without end."""
        self._prior, self._paces = prior, paces
        self._pace, self._left = next(paces)
        self._emphasis = 1
        self._told: dict[str, list[Density]] = {}
        # The frame before which each ends. What reads them is never far behind, if anything does.
        self._pieces = deque[tuple[int, Density]](maxlen=1000)
        self._seen = 0

    def tell(self, longest: int) -> tuple[Density, int]:
        """Return the prior told what is to come, and for how many frames, at most `longest`, it is to be sampled."""
        told = self._told.setdefault(self._pace, [self._prior])  # as often as their index says
        while len(told) <= self._emphasis:
            told.append(told[-1].conditioned_on([label_pace(self._pace)]))
        return told[self._emphasis], min(self._left, longest, _LOOK)

    def see(self, features: Float[Tensor, "frames size"]) -> None:
        """Go on after what was sampled."""
        self._seen += len(features)
        self._pieces.append((self._seen, self._told[self._pace][self._emphasis]))
        self._left -= len(features)
        if self._left == 0:
            (self._pace, self._left), self._emphasis = next(self._paces), 1
            return
        has = find_pace(measure_way_speed(features))
        self._emphasis = 1 if has == self._pace else min(self._emphasis + 1, _MOST_EMPHATIC[self._pace])

    def find_told(self, frame: int) -> Density:
        """Find the prior as it was told when a frame was sampled, counted from 0; earlier frames are then forgotten."""
        while self._pieces[0][0] <= frame:
            self._pieces.popleft()
        return self._pieces[0][1]


def plan_paces(prior: Density, speed: float, generator: torch.Generator) -> PacePlan | None:
    """Plan which paces a prior is told: from the pace of a mean `speed`, m/s, on, as often as its data change. None for
    a prior that knows no paces."""
    if not prior.pace_rates:
        return None
    return PacePlan(prior, draw_paces(prior.pace_rates, find_pace(speed), generator))


def measure_way_speed(features: Float[Tensor, "frames size"]) -> float:
    """Speed of the way that the frames lead, m/s: without the sway of somebody who stands."""
    return float(LAYOUT.pick(features, "root_displacement_heading").mean(0).norm()) * PRIOR_FPS
