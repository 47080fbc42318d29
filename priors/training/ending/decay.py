"""How the learning rate of a run ends whose length was not known when it began."""

import math
from dataclasses import dataclass


@dataclass(frozen=True)
class Decay:
    """The last steps of a run, in which the learning rate falls from its highest to nothing."""

    begin: int
    """Step of the first."""
    steps: int
    """How many there are."""

    @property
    def end(self) -> int:
        """Steps of the run in all."""
        return self.begin + self.steps

    def compute_rate(self, step: int) -> float:
        """Share of the highest learning rate at a step: 1 less the root of the share of the decay that is done, which
        served best among the shapes that Haegele et al. 2024 compare."""
        done = (step - self.begin + 1) / (self.steps + 1)
        return 1 - math.sqrt(min(1.0, max(0.0, done)))

    def __str__(self) -> str:
        return f"{self.begin}:{self.steps}"
