"""Several processes that train one model: each computes the gradients of its share of a step's batch, and all take the
same step by their mean. One machine forks them; torchrun starts them on one machine or several.
"""

import gc
import multiprocessing
import os
import signal
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from datetime import timedelta
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any

import torch
import torch.distributed as dist
from torch import Tensor, nn

from mapctl.errors import MapctlError, RequestError
from mapctl.runtime import forking
from mapctl.runtime.interruption import SIGNALS

_LAUNCHED = ("RANK", "WORLD_SIZE", "MASTER_ADDR", "MASTER_PORT")  # what torchrun tells a process of itself
_TIMEOUT = timedelta(hours=2)  # that processes wait for each other: one reads and validates while the others wait
_END_SECONDS = 5.0  # that a process is given to end by itself


class LostProcessError(MapctlError):
    """A process that trained along has ended."""


class SilentError(MapctlError):
    """Another process has told already why this one ends."""


@dataclass(frozen=True)
class TrainingGroup:
    """The processes of a run, as one of them sees them. All must call its methods in the same order."""

    rank: int = 0
    """Number of this process; 0 validates, writes and speaks."""
    size: int = 1
    """Number of processes."""

    @property
    def leads(self) -> bool:
        """Whether this is the process that validates, writes and speaks."""
        return self.rank == 0

    def share(self, count: int) -> int:
        """How many of `count` things this process takes, at least one; the first processes take what is left over."""
        return max(1, count // self.size + (self.rank < count % self.size))

    def average_gradients(self, weights: Sequence[nn.Parameter], values: Sequence[Tensor]) -> list[Tensor]:
        """Replace the weights' gradients by their mean over the processes; the means of `values`, which are numbers.

        A gradient that only some processes have counts as zero in the others; what none has stays None.
        """
        if self.size == 1:
            return list(values)
        device, dtype = weights[0].device, weights[0].dtype
        present = torch.tensor([float(weight.grad is not None) for weight in weights], device=device, dtype=dtype)
        own = [torch.zeros_like(weight) if weight.grad is None else weight.grad for weight in weights]
        told = [value.detach().to(device, dtype).reshape(1) for value in values]
        flat = torch.cat([present, *told, *(gradient.flatten() for gradient in own)])
        with _tell_loss():
            dist.all_reduce(flat)
        seen, means, gradients = flat.split([len(weights), len(values), len(flat) - len(weights) - len(values)])
        parts = (gradients / self.size).split([weight.numel() for weight in weights])
        for weight, count, mean in zip(weights, seen.tolist(), parts, strict=True):
            weight.grad = mean.view_as(weight) if count else None
        return list((means / self.size).unbind())

    def agree(self, *wishes: bool) -> tuple[bool, ...]:
        """By wish, whether any process has it."""
        if self.size == 1:
            return wishes
        flags = torch.tensor(wishes, dtype=torch.int32, device="cpu")
        with _tell_loss():
            dist.all_reduce(flags, op=dist.ReduceOp.MAX)
        return tuple(bool(flag) for flag in flags.tolist())

    def gather(self, rows: Tensor) -> Tensor:
        """The rows of all processes, one process' after the other's."""
        if self.size == 1:
            return rows
        counts = torch.zeros(self.size, dtype=torch.int64, device="cpu")
        counts[self.rank] = len(rows)
        parts = []
        with _tell_loss():
            dist.all_reduce(counts)
            for rank, count in enumerate(counts.tolist()):
                part = rows.contiguous() if rank == self.rank else rows.new_empty(count, *rows.shape[1:])
                dist.broadcast(part, rank)
                parts.append(part)
        return torch.cat(parts)

    def do_first(self, work: Callable[[], bytes]) -> bytes:
        """What process 0 gets by `work`, in all of them; where it fails, the others end with SilentError."""
        if self.size == 1:
            return work()
        if not self.leads:
            return self._receive()
        try:
            content = work()
        except BaseException:
            with suppress(LostProcessError):
                self._send(None)
            raise
        self._send(content)
        return content

    def _send(self, content: bytes | None) -> None:
        with _tell_loss():
            dist.broadcast(torch.tensor([-1 if content is None else len(content)], device="cpu"), 0)
            if content:
                dist.broadcast(torch.frombuffer(bytearray(content), dtype=torch.uint8), 0)

    def _receive(self) -> bytes:
        count = torch.zeros(1, dtype=torch.int64, device="cpu")
        with _tell_loss():
            dist.broadcast(count, 0)
            if int(count) < 0:
                raise SilentError("process 0 has failed")
            content = torch.empty(int(count), dtype=torch.uint8, device="cpu")
            if len(content):
                dist.broadcast(content, 0)
        return content.numpy().tobytes()


ALONE = TrainingGroup()
"""One process."""


def count_launched() -> int | None:
    """How many processes torchrun has started, this among them; None where this is an ordinary process.

    RequestError where what it tells makes no sense.
    """
    if not all(name in os.environ for name in _LAUNCHED):
        return None
    try:
        rank, size = int(os.environ["RANK"]), int(os.environ["WORLD_SIZE"])
    except ValueError as error:
        raise RequestError(f"RANK and WORLD_SIZE, which torchrun sets, must be numbers ({error})") from error
    if not 0 <= rank < size:
        raise RequestError(f"RANK must be one of the {size} numbers of WORLD_SIZE from 0 on, got {rank}")
    return size


def leads_launched() -> bool:
    """Whether this process may speak: that of torchrun with RANK 0, or an ordinary one."""
    return count_launched() is None or int(os.environ["RANK"]) == 0


@contextmanager
def join_launched() -> Iterator[TrainingGroup]:
    """The processes that torchrun has started; ALONE in an ordinary process. Gloo joins processors, nccl GPUs."""
    size = count_launched()
    if size is None or size == 1:
        yield ALONE
        return
    _require_distributed()
    if torch.cuda.is_available() and (local := int(os.environ.get("LOCAL_RANK", "0"))) < torch.cuda.device_count():
        torch.cuda.set_device(local)
    both = torch.cuda.is_available() and dist.is_nccl_available()
    with _open_group("cpu:gloo,cuda:nccl" if both else "gloo", "env://", int(os.environ["RANK"]), size) as group:
        yield group


@contextmanager
def fork_group(count: int, work: Callable[[TrainingGroup], None]) -> Iterator[TrainingGroup]:
    """Fork processes that do `work` as members of a group of `count`, of which this one is the first.

    Their data are this process' own, copied only where they are changed. LostProcessError where one has failed.
    """
    if count == 1:
        yield ALONE
        return
    _require_distributed()
    if not forking.AVAILABLE:
        raise RequestError(
            "this system cannot fork processes safely; start them with torchrun (docs/guides/training.md)"
        )
    gc.collect()  # a group of an earlier run, thrown away in a child, would wait there for threads that are not forked
    context = multiprocessing.get_context("fork")
    with tempfile.TemporaryDirectory(prefix="mapctl-") as folder:
        meeting = f"file://{Path(folder) / 'meeting'}"
        helpers: list[BaseProcess] = []
        pipes: list[Any] = []
        for rank in range(1, count):
            here, there = context.Pipe(duplex=False)
            helpers.append(context.Process(target=_help, args=(meeting, rank, count, work, there), daemon=True))
            helpers[-1].start()
            there.close()  # before the next is forked: a pipe ends with the last process that holds it
            pipes.append(here)
        try:
            with _open_group("gloo", meeting, 0, count) as group:
                yield group
        except LostProcessError as error:
            raise LostProcessError(f"{_find_words(pipes) or error}; {KEPT}") from error
        finally:
            _end(helpers)


KEPT = "the last checkpoint, if there is one, is kept"
"""What is said of a run that fails."""


def _help(meeting: str, rank: int, count: int, work: Callable[[TrainingGroup], None], told: Connection) -> None:
    """Work as one of a group; why that fails goes to the first process, which alone speaks and is sent signals."""
    for kind in SIGNALS:
        signal.signal(kind, signal.SIG_IGN)
    torch.set_num_threads(1)
    try:
        with _open_group("gloo", meeting, rank, count) as group:
            work(group)
    except (LostProcessError, SilentError):
        told.send("")
    except Exception as error:  # told to the first process, which raises it
        with suppress(OSError):
            told.send(" ".join(f"{type(error).__name__}: {error}".split()))


@contextmanager
def _open_group(backend: str, meeting: str, rank: int, size: int) -> Iterator[TrainingGroup]:
    with _tell_loss():
        dist.init_process_group(backend, init_method=meeting, rank=rank, world_size=size, timeout=_TIMEOUT)
    try:
        yield TrainingGroup(rank, size)
    finally:
        dist.destroy_process_group()


@contextmanager
def _tell_loss() -> Iterator[None]:
    """LostProcessError instead of what torch raises where another process is gone."""
    try:
        yield
    except RuntimeError as error:
        raise LostProcessError("a process that trains along has ended") from error


def _find_words(pipes: Sequence[Any]) -> str:
    """Why a process failed, as it told; nothing where none has failed."""
    for rank, pipe in enumerate(pipes, start=1):
        try:
            if pipe.poll(_END_SECONDS) and (words := pipe.recv()):
                return f"process {rank} of the training failed: {words}"
        except (EOFError, OSError):
            return f"process {rank} of the training failed: it was killed"
    return ""


def _end(helpers: Sequence[BaseProcess]) -> None:
    for helper in helpers:
        helper.join(_END_SECONDS)
        if helper.is_alive():
            helper.kill()
            helper.join()


def _require_distributed() -> None:
    if not (dist.is_available() and dist.is_gloo_available()):
        raise RequestError("this PyTorch cannot train in several processes: it was built without gloo")
