"""Work on many files, in processes (joblib) or on a cluster (ray).

No file's failure stops another; a full disk stops all.
Processes that are started end with this one, and Ctrl-C reaches this one alone.
"""

import multiprocessing
import queue
import signal
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any

from joblib import Parallel, delayed

from mapctl.errors import DiskFullError, MapctlError, RequestError


@dataclass(frozen=True)
class FileJob:
    """One file to be made from another."""

    source: Path
    """Motion file that is read."""
    out: Path
    """File that is written; its folder is made."""


@dataclass(frozen=True)
class FileResult:
    """Outcome of a job."""

    job: FileJob
    """The job."""
    error: str = ""
    """Why there is no result; empty if there is one."""
    frames: int = 0
    """Frames of the motion."""
    seconds: float = 0.0
    """Compute, seconds."""


Work = Callable[[FileJob], FileResult]
"""Function that does one job, cheap to send to a process; errors are in what it returns (see `try_job`)."""


def try_job(job: FileJob, work: Callable[[FileJob], tuple[int, float]]) -> FileResult:
    """Do a job by a function that returns frames and seconds of compute; errors are in what is returned, except
    DiskFullError. The function makes the folder, and writes the file last: one that exists is complete.
    """
    try:
        frames, seconds = work(job)
    except DiskFullError:
        raise  # no other file could be written
    except (MapctlError, OSError) as error:
        return FileResult(job, error=" ".join(str(error).split()))
    except Exception as error:
        return FileResult(job, error=f"{type(error).__name__}: {' '.join(str(error).split())}")
    return FileResult(job, "", frames, seconds)


def run_over_processes(jobs: Sequence[FileJob], work: Work, *, processes: int) -> Iterator[FileResult]:
    """Yield results as jobs end, in so many processes of this machine; a single one is this process."""
    if processes == 1:
        yield from map(work, jobs)
        return
    results: Any = Parallel(n_jobs=processes, return_as="generator_unordered")(delayed(work)(job) for job in jobs)
    yield from results


def run_over_cluster(jobs: Sequence[FileJob], work: Work, *, address: str, workers: int) -> Iterator[FileResult]:
    """Yield results as jobs end, on a ray cluster; `local` starts one of so many workers on this machine. All machines
    must see the files under the same paths. RequestError where ray is not installed or the cluster does not answer.
    """
    try:
        import ray
    except ImportError as error:
        raise RequestError(f"clusters need ray ({error}): pip install 'mapctl[cluster]'") from error
    try:
        if address == "local":
            ray.init(num_cpus=workers, include_dashboard=False, log_to_driver=False, configure_logging=False)
        else:
            ray.init(address=address, log_to_driver=False, configure_logging=False)
    except (ConnectionError, RuntimeError, ValueError) as error:
        raise RequestError(f"no ray cluster at {address} ({' '.join(str(error).split())})") from error
    try:

        def do(job: FileJob) -> FileResult:
            return work(job)

        task = ray.remote(num_cpus=1, max_retries=2)(do)
        waiting = {task.remote(job): job for job in jobs}
        while waiting:
            ready, _ = ray.wait(list(waiting), num_returns=1)
            job = waiting.pop(ready[0])
            try:
                yield ray.get(ready[0])
            except ray.exceptions.RayError as error:
                yield FileResult(job, error=" ".join(str(error).split())[:200])
    finally:
        ray.shutdown()


_CONTEXT: Any = multiprocessing.get_context("forkserver" if sys.platform == "linux" else "spawn")


def preload(*modules: str) -> None:
    """Have these modules imported once for all processes that are started here, where the system can fork them."""
    if sys.platform == "linux":
        _CONTEXT.set_forkserver_preload([*modules])


def spawn(target: Callable[..., None], *arguments: Any) -> BaseProcess:
    """Start a process that runs `target`, and ends when this one does. Both are sent there, so that they must be
    importable by name, and a script needs its `if __name__ == "__main__"`."""
    process: BaseProcess = _CONTEXT.Process(target=_run, args=(target, *arguments), daemon=True)
    process.start()
    return process


def open_pipe(*, duplex: bool = True) -> tuple[Connection, Connection]:
    """Open a pipe and return its ends: the first reads and the second writes, or `duplex` both do both."""
    ends: Any = multiprocessing.Pipe(duplex)  # its type differs by system
    return ends


def send_queued(connection: Connection, messages: "queue.SimpleQueue[Any]") -> None:
    """Send queued messages, until None or the end of the process at the other end: for a thread, which may wait."""
    with suppress(OSError):
        while (message := messages.get()) is not None:
            connection.send(message)


def _run(target: Callable[..., None], *arguments: Any) -> None:
    """Run the target in the new process. A terminal sends Ctrl-C to all of its processes."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    target(*arguments)
