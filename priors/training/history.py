"""What a critic remembers of what was made before (Wang et al. 2019, section 4.2.2)."""

import torch
from jaxtyping import Float
from torch import Tensor


class HistoryBuffer:
    """Windows that earlier weights made, so that the critic does not forget faults that it once knew."""

    def __init__(self, windows: Float[Tensor, "size frames features"]):
        self.windows = windows.clone()

    def mix(self, fresh: Float[Tensor, "batch frames features"], generator: torch.Generator) -> Tensor:
        """Half a batch of the fresh ones, half of kept ones; then the fresh half takes the place of kept ones."""
        half = len(fresh) // 2
        picked = torch.randperm(len(self.windows), generator=generator)
        mixed = torch.cat([fresh[: len(fresh) - half], self.windows[picked[:half]]])
        self.windows[picked[half : 2 * half]] = fresh[:half]
        return mixed

    def keep(self, fresh: Float[Tensor, "batch frames features"], generator: torch.Generator) -> None:
        """Put the fresh ones in the place of kept ones."""
        picked = torch.randperm(len(self.windows), generator=generator)[: len(fresh)]
        self.windows[picked] = fresh[: len(picked)]

    def draw(self, count: int, generator: torch.Generator) -> Float[Tensor, "count frames features"]:
        """Draw so many of the kept ones, any of them more than once."""
        return self.windows[torch.randint(len(self.windows), (count,), generator=generator)]
