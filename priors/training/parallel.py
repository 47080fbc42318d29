"""Gradients of several batches at once: one process each, all on the same weights in shared memory."""

import multiprocessing
import signal
from collections.abc import Mapping, Sequence
from contextlib import suppress
from multiprocessing.connection import Connection
from multiprocessing.util import Finalize
from typing import Any, Protocol, runtime_checkable

import torch
from torch import Tensor, nn

from mapctl.errors import MapctlError, RequestError


@runtime_checkable
class BatchTrainer(Protocol):
    """What draws a batch and computes its loss."""

    generator: torch.Generator
    step: int

    def networks(self) -> Mapping[str, nn.Module]:
        """All whose weights change."""
        ...

    def weights(self) -> list[nn.Parameter]:
        """All that the loss is differentiated by."""
        ...

    def losses(self) -> dict[str, Tensor]:
        """Losses of a newly drawn batch; `loss` is the one to differentiate."""
        ...


class GradientHelpers:
    """Processes forked from a trainer. They draw batches of their own; only the trainer's own process changes weights.

    A step's random numbers come from the trainer's generator, so a resumed run repeats them.
    """

    def __init__(self, trainer: BatchTrainer, count: int):
        """Fork so many, whose data is the trainer's; its networks' weights move to shared memory."""
        self._trainer = trainer
        for network in trainer.networks().values():
            network.share_memory()
        self._weights = [weight for weight in trainer.weights() if weight.requires_grad]
        size = sum(weight.numel() for weight in self._weights)
        if "fork" not in multiprocessing.get_all_start_methods():
            raise RequestError("training in several processes needs a system that can fork them")
        # Not spawned: a copy of the corpus for every process would not fit.
        context = multiprocessing.get_context("fork")
        self._found = torch.zeros(count, size).share_memory_()
        pipes = [context.Pipe() for _ in range(count)]
        self._connections = [here for here, _ in pipes]
        # Helpers ignore the signal by which multiprocessing ends its processes; before that their pipes are closed.
        Finalize(self, _close, args=(self._connections,), exitpriority=1)
        for (_, there), found in zip(pipes, self._found, strict=True):
            context.Process(target=self._serve, args=(there, found), daemon=True).start()
        for _, there in pipes:
            there.close()

    def begin(self) -> None:
        """Let every process draw a batch and compute its gradients at today's weights."""
        for connection in self._connections:
            seed = int(torch.randint(2**62, (), generator=self._trainer.generator))
            with suppress(OSError):  # of a process that is gone; `finish` tells
                connection.send((self._trainer.step, seed))

    def finish(self, parts: dict[str, Tensor]) -> dict[str, Tensor]:
        """Average the weights' gradients with theirs; the losses, averaged. MapctlError if one has failed."""
        received = [_receive(connection) for connection in self._connections]
        share = 1 / (1 + len(received))
        found = self._found.sum(dim=0).split([weight.numel() for weight in self._weights])
        for weight, others in zip(self._weights, found, strict=True):
            own = torch.zeros_like(weight) if weight.grad is None else weight.grad
            weight.grad = share * (own + others.view_as(weight))
        return {name: share * (value.detach() + sum(each[name] for each in received)) for name, value in parts.items()}

    def _serve(self, requests: Connection, found: Tensor) -> None:
        """Answer requests until the trainer's process is gone, which a pipe whose other ends are closed tells."""
        _close(self._connections)
        for kind in (signal.SIGINT, signal.SIGTERM):
            signal.signal(kind, signal.SIG_IGN)
        torch.set_num_threads(1)
        while True:
            try:
                self._trainer.step, seed = requests.recv()
            except EOFError:
                return
            self._trainer.generator.manual_seed(seed)
            try:
                parts = self._trainer.losses()
                gradients = torch.autograd.grad(parts["loss"], self._weights, materialize_grads=True)
            except Exception as error:  # told to the trainer's process, which raises it
                requests.send(f"{type(error).__name__}: {error}")
                continue
            torch.cat([gradient.flatten() for gradient in gradients], out=found)
            requests.send({name: float(value.detach()) for name, value in parts.items()})


def _close(connections: Sequence[Any]) -> None:
    for connection in connections:
        connection.close()


def _receive(connection: Any) -> dict[str, float]:
    try:
        answer = connection.recv()
    except (EOFError, OSError):
        answer = "it was killed"
    if isinstance(answer, str):
        raise MapctlError(f"a process that computes gradients failed: {answer}")
    return answer
