"""What is trained, whatever it learns: a step at a time, resumed to the bit."""

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping
from typing import Any, Generic, TypeVar

import torch
from torch import Tensor, nn

from mapctl.errors import MapctlError
from priors.training import run_files
from priors.training.corpus import Corpus
from priors.training.devices import make_generator, use_device
from priors.training.ending.decay import Decay
from priors.training.parallel import ALONE, TrainingGroup

_WARM_UP_SHARE = 0.05  # share of the steps in which the learning rate rises
_MAX_GRADIENT_NORM = 1.0

Network = TypeVar("Network", bound=nn.Module)


class Trainer(ABC, Generic[Network]):
    """A network and what teaches it. Everything random comes from one generator."""

    network: Network
    """What is validated, and exported at the end."""

    def __init__(self, *, steps: int, seed: int):
        self.step, self.steps = 0, steps
        self.first_steps = steps
        """Steps that the run was begun with: what grows with the share of the steps that are done, or joins at one,
        goes by these. Only the learning rate follows `steps` where the run is extended."""
        self.steady = False
        """Whether the learning rate stays at its highest until `decay` rather than follow a cosine over `steps`."""
        self.decay: Decay | None = None
        """Last steps of such a run, once it is known where they begin."""
        self.group = ALONE
        self.seed = seed
        self.generator = make_generator(seed)
        """Draws what belongs to this process' share of a batch."""
        self.common = self.generator
        """Draws what all processes of a step have in common, as the length of its windows."""

    def join(self, group: TrainingGroup) -> None:
        """Train as one of a group from here on; all members are the same until then."""
        self.group = group
        if group.size > 1:
            self.common = make_generator(self.seed)
            self.common.set_state(self.generator.get_state())

    def set_first_steps(self, steps: int) -> None:
        """Set the steps that the run was begun with, where they are not those that it goes on to."""
        self.first_steps = steps

    def hold_rate(self, most: int) -> None:
        """Keep the learning rate at its highest until a decay begins, over `most` steps in all."""
        self.steady, self.steps = True, most

    def begin_decay(self, decay: Decay) -> None:
        """Let the learning rate fall to nothing in these steps, which are the last."""
        self.decay, self.steps = decay, decay.end

    def take_step(self) -> dict[str, float]:
        """One step of all processes, each with random numbers of its own; the parts of its loss, means over them."""
        if self.group.size > 1:
            seeds = torch.randint(2**62, (self.group.size,), generator=self.common)
            self.generator.manual_seed(int(seeds[self.group.rank]))
        return self.train_step()

    def differentiate(
        self,
        loss: Tensor | None,
        weights: Iterable[nn.Parameter],
        told: Mapping[str, Tensor],
        *,
        retain_graph: bool = False,
    ) -> dict[str, float]:
        """Leave the loss' gradients in the weights, and return the numbers in `told`: means over the processes. A
        process without a loss waits for those of the others; a retained graph serves another loss as well."""
        if loss is not None:
            loss.backward(retain_graph=retain_graph)
        learnt = [weight for weight in weights if weight.requires_grad]
        values = self.group.average_gradients(learnt, [value.detach() for value in told.values()])
        return {name: float(value) for name, value in zip(told, values, strict=True)}

    @abstractmethod
    def train_step(self) -> dict[str, float]:
        """Take one step; the parts of its loss."""

    @abstractmethod
    def validate(self, corpus: Corpus) -> dict[str, Any]:
        """Measure the network on held-out clips."""

    def networks(self) -> dict[str, nn.Module]:
        """All that is learnt, by its name in checkpoints."""
        return {"network": self.network}

    def optimisers(self) -> dict[str, torch.optim.Optimizer]:
        """All optimisers, by their names in checkpoints."""
        return {}

    def check_finite(self) -> None:
        """MapctlError unless every weight is a number."""
        if not all(bool(torch.isfinite(values).all()) for values in self.network.parameters()):
            raise make_divergence_error(self.step, "its weights are not finite")

    def state(self) -> dict[str, Tensor]:
        """Everything that a bit-exact continuation needs, but the step; all processes of the group are to call it."""
        tensors = {"generator": self.common.get_state()}
        for kind, network in self.networks().items():
            tensors |= {f"{kind}.{name}": value for name, value in network.state_dict().items()}
        for kind, optimiser in self.optimisers().items():
            tensors |= run_files.flatten_optimiser(optimiser, kind)
        return tensors

    def load_state(self, tensors: Mapping[str, Tensor], step: int) -> None:
        """Go on from what `state` gave, before a group is joined; KeyError or RuntimeError where it is not whole."""
        self._set_generator(tensors["generator"], step)
        for kind, network in self.networks().items():
            network.load_state_dict(run_files.select_prefixed(f"{kind}.", tensors))
        for kind, optimiser in self.optimisers().items():
            optimiser.load_state_dict(run_files.unflatten_optimiser(optimiser, kind, tensors))
        self.step = step

    def move(self, device: str) -> None:
        """Take what is learnt to a device, where it is then measured; what training draws from stays where it is."""
        for network in self.networks().values():
            network.to(device)

    def _set_generator(self, state: Tensor, step: int) -> None:
        """The state of another kind of device's generator says nothing here: numbers are drawn anew from this step."""
        if state.shape == self.common.get_state().shape:
            self.common.set_state(state)
        else:
            self.common.manual_seed(self.seed + step)


class GradientTrainer(Trainer[Network]):
    """One network, one loss: AdamW, unless another is made; the learning rate rises, then falls along a cosine."""

    def __init__(self, make: Callable[[], Network], *, steps: int, learning_rate: float, seed: int):
        """`make` builds the network (see `draw_weights`)."""
        super().__init__(steps=steps, seed=seed)
        self.learning_rate = learning_rate
        self.network = draw_weights(make, seed).to(torch.get_default_device())
        self._optimisers = self.make_optimisers()

    @abstractmethod
    def losses(self) -> dict[str, Tensor]:
        """Compute the losses of a newly drawn batch: `loss`, and its parts in plain units."""

    def make_optimisers(self) -> dict[str, torch.optim.Optimizer]:
        """For the network's weights, by their names in checkpoints; all have the same learning rate."""
        return {"optimiser": make_adam(self.weights(), self.learning_rate)}

    def weights(self) -> list[nn.Parameter]:
        """All that the loss is differentiated by."""
        return list(self.network.parameters())

    def compute_learning_rate(self) -> float:
        """At the current step."""
        if self.steady:
            return self.learning_rate * find_rise(self.step, self.first_steps) * self.find_fall()
        return self.learning_rate * warmup_cosine(self.step, self.steps)

    def find_fall(self) -> float:
        """Share of the highest learning rate of a steady run: 1 until its decay begins."""
        return 1.0 if self.decay is None else self.decay.compute_rate(self.step)

    def limit_gradients(self) -> None:
        """Clip what the loss has left in the weights, before the optimiser's step."""
        nn.utils.clip_grad_norm_(self.weights(), _MAX_GRADIENT_NORM)

    def train_step(self) -> dict[str, float]:
        """One update; the parts of its loss. MapctlError, and no update, where that is no number."""
        optimisers = self._optimisers.values()
        for group in [group for optimiser in optimisers for group in optimiser.param_groups]:
            group["lr"] = self.compute_learning_rate()
        for optimiser in optimisers:
            optimiser.zero_grad(set_to_none=True)
        losses = self.losses()
        parts = self.differentiate(losses["loss"], self.weights(), losses)
        if not math.isfinite(parts["loss"]):
            raise make_divergence_error(self.step + 1, f"the loss is {parts['loss']}")
        self.limit_gradients()
        for optimiser in optimisers:
            optimiser.step()
        self.step += 1
        return parts

    def optimisers(self) -> dict[str, torch.optim.Optimizer]:
        """All."""
        return self._optimisers


def make_adam(weights: Iterable[nn.Parameter], learning_rate: float) -> torch.optim.Optimizer:
    """The usual optimiser."""
    return torch.optim.AdamW(weights, lr=learning_rate, weight_decay=1e-4)


Drawn = TypeVar("Drawn")


def draw_weights(make: Callable[[], Drawn], seed: int) -> Drawn:
    """What `make` builds of torch's global generator, seeded; the caller's own numbers are left alone. It is made on
    the processor, so that it is the same whatever device it is then taken to."""
    with use_device("cpu"), torch.random.fork_rng(devices=[]):
        torch.default_generator.manual_seed(seed)
        return make()


def make_divergence_error(step: int, how: str) -> MapctlError:
    """For a run whose numbers are none any more."""
    return MapctlError(f"training diverged at step {step}: {how}; the last checkpoint, if there is one, is kept")


def warmup_cosine(step: int, steps: int) -> float:
    """Share of the highest learning rate: rising, then along a cosine to nothing."""
    rise = max(1, round(_WARM_UP_SHARE * steps))
    if step < rise:
        return (step + 1) / rise
    return 0.5 * (1 + math.cos(math.pi * (step - rise) / max(1, steps - rise)))


def find_rise(step: int, steps: int) -> float:
    """Share of the highest learning rate in the beginning of a run of so many steps; 1 from then on."""
    return min(1.0, (step + 1) / max(1, round(_WARM_UP_SHARE * steps)))
