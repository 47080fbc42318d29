"""A network and how it takes one step of training.

Where training computes: on processors, or on a GPU with CUDA.

Inside `use_device` that is torch's default device, so that windows, networks and random numbers are made there.
"""

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any, Generic, TypeVar

import torch
from jaxtyping import Float
from torch import Tensor, nn

from mapctl.errors import MapctlError, RequestError
from priors.training.corpus import Corpus


def select_device(wanted: str) -> str:
    """Return the device of `auto`, `cpu` or `cuda`; RequestError where this machine has none."""
    if wanted not in ("auto", "cpu", "cuda"):
        raise RequestError(f"device must be auto, cpu or cuda, got {wanted!r}")
    if wanted == "cuda" and not torch.cuda.is_available():
        raise RequestError("this machine has no CUDA device; use --device cpu")
    return ("cuda" if torch.cuda.is_available() else "cpu") if wanted == "auto" else wanted


@contextmanager
def use_device(name: str) -> Iterator[None]:
    """Make tensors on this device unless another is given."""
    if torch.get_default_device().type == torch.device(name).type:
        yield  # as it is: a default of torch's costs each of its calls a little
        return
    with torch.device(name):
        yield


def make_generator(seed: int) -> torch.Generator:
    """Make a generator that draws on the device in use."""
    return torch.Generator(torch.get_default_device()).manual_seed(seed)


Network = TypeVar("Network", bound=nn.Module)
Drawn = TypeVar("Drawn")
_WARM_UP_SHARE = 0.05  # share of the steps in which the learning rate rises
_MAX_GRADIENT_NORM = 1.0


class Trainer(ABC, Generic[Network]):
    """A network and what trains it. Everything random comes from one generator."""

    network: Network
    """The network that is trained."""

    def __init__(self, *, steps: int, seed: int):
        self.step, self.steps, self.seed = 0, steps, seed
        self.generator = make_generator(seed)

    @abstractmethod
    def train_step(self) -> dict[str, float]:
        """Take one step; return the parts of its loss."""

    @abstractmethod
    def validate(self, corpus: Corpus) -> dict[str, Any]:
        """Measure the network on held-out clips."""

    @property
    def exported(self) -> Network:
        """The network that is validated, and exported at the end."""
        return self.network

    def networks(self) -> dict[str, nn.Module]:
        """Return all that is trained, by its name in checkpoints."""
        return {"network": self.network}

    def optimisers(self) -> dict[str, torch.optim.Optimizer]:
        """Return all optimisers, by their names in checkpoints."""
        return {}

    def check_finite(self) -> None:
        """Raise MapctlError unless every weight is finite."""
        if not all(bool(torch.isfinite(values).all()) for values in self.exported.parameters()):
            raise make_divergence_error(self.step, "its weights are not finite")

    def state(self) -> dict[str, Tensor]:
        """Return everything that a continuation needs, but the step."""
        tensors = {"generator": self.generator.get_state()}
        for kind, network in self.networks().items():
            tensors |= {f"{kind}.{name}": value for name, value in network.state_dict().items()}
        for kind, optimiser in self.optimisers().items():
            for number, entries in optimiser.state_dict()["state"].items():
                tensors |= {f"{kind}.{number}.{key}": torch.as_tensor(value) for key, value in entries.items()}
        return tensors

    def load_state(self, tensors: Mapping[str, Tensor], step: int) -> None:
        """Go on from what `state` returned; KeyError or RuntimeError where it is not whole."""
        if tensors["generator"].shape == self.generator.get_state().shape:
            self.generator.set_state(tensors["generator"])
        else:  # that of another kind of device
            self.generator.manual_seed(self.seed + step)
        for kind, network in self.networks().items():
            network.load_state_dict(select_prefixed(f"{kind}.", tensors))
        for kind, optimiser in self.optimisers().items():
            state: dict[int, dict[str, Tensor]] = {}
            for name, tensor in select_prefixed(f"{kind}.", tensors).items():
                number, key = name.split(".", 1)
                state.setdefault(int(number), {})[key] = tensor
            optimiser.load_state_dict({"state": state, "param_groups": optimiser.state_dict()["param_groups"]})
        self.step = step


class GradientTrainer(Trainer[Network]):
    """One network, one loss: AdamW, unless another is made; the learning rate rises, then falls along a cosine."""

    def __init__(self, make: Callable[[], Network], settings: Any):
        """`make` builds the network (see `draw_weights`); settings have steps, a learning rate and a seed."""
        super().__init__(steps=settings.steps, seed=settings.seed)
        self.settings, self.learning_rate, self.grown = settings, settings.learning_rate, False
        self.network = draw_weights(make, settings.seed).to(torch.get_default_device())
        self._optimisers = self.make_optimisers()

    @property
    def progress(self) -> float:
        """Share of training that is done, by which tasks become harder; 1 where the weights began as trained ones."""
        return 1.0 if self.grown else self.step / self.steps

    @abstractmethod
    def losses(self) -> dict[str, Tensor]:
        """Compute the losses of a newly drawn batch: `loss`, and its parts in plain units."""

    def make_optimisers(self) -> dict[str, torch.optim.Optimizer]:
        """Make those of the network's weights, by their names in checkpoints; all have the same learning rate."""
        return {"optimiser": make_adam(self.weights(), self.learning_rate)}

    def optimisers(self) -> dict[str, torch.optim.Optimizer]:
        """Return all optimisers, by their names in checkpoints."""
        return self._optimisers

    def weights(self) -> list[nn.Parameter]:
        """Return all that the loss is differentiated by."""
        return list(self.network.parameters())

    def compute_learning_rate(self) -> float:
        """Compute that of the current step."""
        return self.learning_rate * warmup_cosine(self.step, self.steps)

    def limit_gradients(self) -> None:
        """Clip the gradients before the optimiser's step."""
        nn.utils.clip_grad_norm_(self.weights(), _MAX_GRADIENT_NORM)

    def train_step(self) -> dict[str, float]:
        """Take one update; return the parts of its loss. MapctlError, and no update, where that is not finite."""
        optimisers = self._optimisers.values()
        for group in [group for optimiser in optimisers for group in optimiser.param_groups]:
            group["lr"] = self.compute_learning_rate()
        for optimiser in optimisers:
            optimiser.zero_grad(set_to_none=True)
        losses = self.losses()
        losses["loss"].backward()
        parts = {name: float(value.detach()) for name, value in losses.items()}
        if not math.isfinite(parts["loss"]):
            raise make_divergence_error(self.step + 1, f"the loss is {parts['loss']}")
        self.limit_gradients()
        for optimiser in optimisers:
            optimiser.step()
        self.step += 1
        return parts


def make_adam(weights: Iterable[nn.Parameter], learning_rate: float) -> torch.optim.Optimizer:
    """Make the usual optimiser."""
    return torch.optim.AdamW(weights, lr=learning_rate, weight_decay=1e-4)


def draw_weights(make: Callable[[], Drawn], seed: int) -> Drawn:
    """Return what `make` builds with torch's global generator, seeded, whose own numbers are left alone. It is made on
    the processor, so that it is the same whatever device it is then moved to."""
    with use_device("cpu"), torch.random.fork_rng(devices=[]):
        torch.default_generator.manual_seed(seed)
        return make()


def make_divergence_error(step: int, how: str) -> MapctlError:
    """Make the error of a run whose numbers are no longer finite."""
    return MapctlError(f"training diverged at step {step}: {how}; the last checkpoint, if there is one, is kept")


def warmup_cosine(step: int, steps: int) -> float:
    """Return the share of the highest learning rate: rising, then along a cosine to zero."""
    rise = max(1, round(_WARM_UP_SHARE * steps))
    if step < rise:
        return (step + 1) / rise
    return 0.5 * (1 + math.cos(math.pi * (step - rise) / max(1, steps - rise)))


def select_prefixed(prefix: str, tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Select those whose names begin so, without it."""
    return {name.removeprefix(prefix): tensor for name, tensor in tensors.items() if name.startswith(prefix)}


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
