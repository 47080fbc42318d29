"""What training a network on drawn windows is, whatever it learns: one update at a time, resumed to the bit."""

import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Generic, TypeVar

import torch
from torch import Tensor, nn

from priors.training import run_files

_WARM_UP_SHARE = 0.05  # share of the steps in which the learning rate rises
_MAX_GRADIENT_NORM = 1.0

Network = TypeVar("Network", bound=nn.Module)


class Trainer(ABC, Generic[Network]):
    """Network, optimiser and generator. AdamW; the learning rate rises, then falls to nothing along a cosine."""

    def __init__(self, make: Callable[[], Network], *, steps: int, learning_rate: float, seed: int):
        """`make` builds the network; its weights are drawn with the seed, and the global generator is left alone."""
        self.step, self.steps, self.learning_rate = 0, steps, learning_rate
        self.generator = torch.Generator().manual_seed(seed)
        with torch.random.fork_rng(devices=[]):
            torch.default_generator.manual_seed(seed)
            self.network = make()
        self.optimiser = torch.optim.AdamW(self.network.parameters(), lr=learning_rate, weight_decay=1e-4)

    @abstractmethod
    def losses(self) -> dict[str, Tensor]:
        """Of a batch drawn anew: `loss`, and in plain units what it is made of."""

    def train_step(self) -> dict[str, float]:
        """One update; the parts of its loss."""
        for group in self.optimiser.param_groups:
            group["lr"] = self.learning_rate * warmup_cosine(self.step, self.steps)
        parts = self.losses()
        self.optimiser.zero_grad()
        parts["loss"].backward()
        torch.nn.utils.clip_grad_norm_(self.network.parameters(), _MAX_GRADIENT_NORM)
        self.optimiser.step()
        self.step += 1
        return {name: float(value.detach()) for name, value in parts.items()}

    def state(self) -> dict[str, Tensor]:
        """Everything that a bit-exact continuation needs, but the step."""
        tensors = {f"network.{name}": value for name, value in self.network.state_dict().items()}
        tensors |= run_files.flatten_optimiser(self.optimiser, "optimiser")
        return tensors | {"generator": self.generator.get_state()}

    def load_state(self, tensors: dict[str, Tensor], step: int) -> None:
        """Inverse of `state`; KeyError or RuntimeError for tensors that are not its."""
        own = {n.removeprefix("network."): t for n, t in tensors.items() if n.startswith("network.")}
        self.network.load_state_dict(own)
        self.optimiser.load_state_dict(run_files.unflatten_optimiser(self.optimiser, "optimiser", tensors))
        self.generator.set_state(tensors["generator"])
        self.step = step


def warmup_cosine(step: int, steps: int) -> float:
    """Share of the highest learning rate: rising, then along a cosine to nothing."""
    rise = max(1, round(_WARM_UP_SHARE * steps))
    if step < rise:
        return (step + 1) / rise
    return 0.5 * (1 + math.cos(math.pi * (step - rise) / max(1, steps - rise)))
