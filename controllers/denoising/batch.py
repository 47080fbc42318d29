"""Denoise many files, in processes (joblib) or on a cluster (ray). No file's failure stops another; a full disk stops
all.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import torch
from joblib import Parallel, delayed

from controllers.denoising.denoise import denoise
from controllers.denoising.result import DenoiseSolution
from controllers.denoising.segment import DenoiseSettings
from mapctl import formats
from mapctl.errors import DiskFullError, MapctlError, RequestError
from mapctl.protocols import Denoiser, Inbetweener
from mapctl.recording.masks import masks_from_missing
from mapctl.retarget.rigs import Rig


@dataclass(frozen=True)
class FileJob:
    """One file to denoise."""

    source: Path
    """Motion file of the capture."""
    out: Path
    """File of the clean motion; its folder is made."""


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


@dataclass(frozen=True)
class FileDenoiser:
    """Denoiser of single files, cheap to send to a process, which loads the network on first use."""

    load: Callable[[], Denoiser]
    """Loader of the network: `functools.partial(priors.load_denoiser, "denoiser")`."""
    settings: DenoiseSettings
    """Settings for all files."""
    load_inbetweener: Callable[[], Inbetweener] | None = None
    """Loader of the network that fills what is lost for longer; None leaves that to the denoiser."""
    rig: Rig | None = None
    """Rig of all files, where it is not the one that would be recognised."""
    after: Callable[[FileJob, DenoiseSolution], None] | None = None
    """Function called with each result, in that process: to write a report."""

    def __call__(self, job: FileJob) -> FileResult:
        """Denoise one file and write the result; errors are in what is returned, except DiskFullError."""
        torch.set_num_threads(1)
        try:
            unit = None if self.rig is None else self.rig.metres_per_unit
            motion, missing = formats.load_with_missing(job.source, metres_per_unit=unit)
            masks = masks_from_missing(motion, missing)
            inbetweener = None if self.load_inbetweener is None else _load_once(self.load_inbetweener)
            denoiser = _load_once(self.load)
            done = denoise(motion, denoiser, inbetweener=inbetweener, masks=masks, settings=self.settings, rig=self.rig)
            job.out.parent.mkdir(parents=True, exist_ok=True)
            if self.after is not None:
                self.after(job, done)
            # Last, so that a file that exists is complete.
            formats.save(done.motion, job.out)
        except DiskFullError:
            raise  # no other file could be written
        except (MapctlError, OSError) as error:
            return FileResult(job, error=" ".join(str(error).split()))
        except Exception as error:
            return FileResult(job, error=f"{type(error).__name__}: {' '.join(str(error).split())}")
        return FileResult(job, "", done.motion.num_frames, done.seconds)


_Network = TypeVar("_Network", Denoiser, Inbetweener)
_LOADED: dict[str, Any] = {}  # the denoiser and the in-betweener that this process loaded last


def _load_once(load: Callable[[], _Network]) -> _Network:
    key = repr(load)
    if key not in _LOADED:
        if len(_LOADED) > 1:
            _LOADED.clear()
        _LOADED[key] = load()
    return _LOADED[key]


def run_over_processes(jobs: Sequence[FileJob], file_denoiser: FileDenoiser, *, processes: int) -> Iterator[FileResult]:
    """Yield results as jobs end, in so many processes of this machine; a single one is this process."""
    if processes == 1:
        yield from map(file_denoiser, jobs)
        return
    results: Any = Parallel(n_jobs=processes, return_as="generator_unordered")(
        delayed(file_denoiser)(job) for job in jobs
    )
    yield from results


def run_over_cluster(
    jobs: Sequence[FileJob], file_denoiser: FileDenoiser, *, address: str, workers: int
) -> Iterator[FileResult]:
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

        def clean(job: FileJob) -> FileResult:
            return file_denoiser(job)

        task = ray.remote(num_cpus=1, max_retries=2)(clean)
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
