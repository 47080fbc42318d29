"""Accuracy with which a small network learns to tell two sets of windows apart: 50 % where it cannot."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor, nn

from mapctl.errors import RequestError

_LEAST_STD = 1e-3
"""Floor of a channel's standard deviation, m or m/s."""


@dataclass(frozen=True)
class ClassifierSettings:
    """Settings of the network and its training: about 10 s an accuracy on one core at 90 clips."""

    folds: int = 4
    """Number of parts of the clips; each is held out once while a network learns on the others."""
    steps: int = 400
    """Number of optimiser steps of each network, so that large sets cost no more than small ones. More make a stricter
    judge."""
    batch: int = 64
    """Number of windows a step, half from each set."""
    width: int = 48
    """Number of channels of each convolution."""
    dropout: float = 0.3
    """Share of activations that are dropped in training."""
    learning_rate: float = 1e-3
    """Learning rate of AdamW, a number without unit."""
    weight_decay: float = 1e-2
    """Weight decay of AdamW, a number without unit."""

    def __post_init__(self):
        for name, least in (("folds", 2), ("steps", 1), ("batch", 2), ("width", 1)):
            if getattr(self, name) < least:
                raise RequestError(f"{name} must be at least {least}, got {getattr(self, name)}")


def compute_held_out_accuracy(
    first: Sequence[Float[Tensor, "_ frames channels"]],
    second: Sequence[Float[Tensor, "_ frames channels"]],
    *,
    generator: torch.Generator,
    settings: ClassifierSettings = ClassifierSettings(),
    tick: Callable[[], None] = lambda: None,
) -> float:
    """Compute the balanced accuracy, 0 to 1, of networks on clips that their training did not see, mean over folds.

    Each set is a list of clips' windows. Folds are by clip, for windows of one clip overlap; `tick` is called after
    each. The same generator state gives the same bits; torch's global generator and thread count are left as they were.
    RequestError for sets of fewer clips than folds.
    """
    if min(len(first), len(second)) < settings.folds:
        raise RequestError(f"{settings.folds} folds need as many clips in each set, got {len(first)} and {len(second)}")
    sets = [(clips, torch.randperm(len(clips), generator=generator).tolist()) for clips in (first, second)]
    total = 0.0
    for fold in range(settings.folds):
        others = [k for k in range(settings.folds) if k != fold]
        training = [torch.cat([clips[i] for k in others for i in order[k :: settings.folds]]) for clips, order in sets]
        held_out = [torch.cat([clips[i] for i in order[fold :: settings.folds]]) for clips, order in sets]
        with _isolate_torch(generator):
            network = _train_network(training, settings)
            total += balanced_accuracy(*(score(network, windows) for windows in held_out))
        tick()
    return total / settings.folds


@contextmanager
def _isolate_torch(generator: torch.Generator) -> Iterator[None]:
    """Seed torch's global generator from ours (weights and dropout draw from it) and use one thread, within."""
    threads = torch.get_num_threads()
    seed = int(torch.randint(2**62, (1,), generator=generator))
    with torch.random.fork_rng(devices=[]):
        torch.default_generator.manual_seed(seed)
        torch.set_num_threads(1)
        try:
            yield
        finally:
            torch.set_num_threads(threads)


class _Standardise(nn.Module):
    """Channels to zero mean and unit deviation, and to the front, where convolutions want them."""

    def __init__(self, windows: Float[Tensor, "windows frames channels"]):
        super().__init__()
        self.mean, self.std = windows.mean((0, 1)), windows.std((0, 1), correction=0).clamp_min(_LEAST_STD)

    def forward(self, windows: Float[Tensor, "batch frames channels"]) -> Float[Tensor, "batch channels frames"]:
        return ((windows - self.mean) / self.std).transpose(1, 2)


def _build_network(windows: Float[Tensor, "windows frames channels"], settings: ClassifierSettings) -> nn.Module:
    """Build three convolutions over time, the mean over the remaining frames, and one logit: positive for the first
    set."""
    layers: list[nn.Module] = [_Standardise(windows)]
    channels = windows.shape[-1]
    for stride in (1, 2, 2):
        layers += [nn.Conv1d(channels, settings.width, 5, stride, padding=2), nn.LeakyReLU(0.2)]
        layers.append(nn.Dropout(settings.dropout))
        channels = settings.width
    return nn.Sequential(*layers, nn.AdaptiveAvgPool1d(1), nn.Flatten(), nn.Linear(channels, 1), nn.Flatten(0))


def _train_network(sets: Sequence[Float[Tensor, "_ frames channels"]], settings: ClassifierSettings) -> nn.Module:
    network = _build_network(torch.cat(list(sets)), settings)
    optimiser = torch.optim.AdamW(network.parameters(), lr=settings.learning_rate, weight_decay=settings.weight_decay)
    half = settings.batch // 2
    target = torch.cat([torch.ones(half), torch.zeros(half)])
    for _ in range(settings.steps):
        batch = torch.cat([windows[torch.randint(len(windows), (half,))] for windows in sets])
        loss = nn.functional.binary_cross_entropy_with_logits(network(batch), target)
        optimiser.zero_grad(set_to_none=True)
        loss.backward()
        optimiser.step()
    return network.eval()


@torch.no_grad()
def score(network: nn.Module, windows: Float[Tensor, "windows frames channels"]) -> Float[Tensor, " windows"]:
    """Return the logits of windows, positive for the first set, a few hundred windows at a time."""
    return torch.cat([network(part) for part in windows.split(512)])


def balanced_accuracy(first: Float[Tensor, " first"], second: Float[Tensor, " second"]) -> float:
    """Return the mean over both sets of the share of windows whose logit names their own set."""
    return (float((first > 0).double().mean()) + 1 - float((second > 0).double().mean())) / 2
