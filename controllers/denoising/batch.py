"""Denoise one of many files, in a process of its own (see mapctl.runtime.file_jobs)."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeVar

import torch

from controllers.denoising.denoise import denoise
from controllers.denoising.result import DenoiseSolution
from controllers.denoising.segment import DenoiseSettings
from mapctl import formats
from mapctl.motion import Motion, join_licences
from mapctl.protocols import Denoiser, Inbetweener
from mapctl.recording.masks import masks_from_missing
from mapctl.retarget.rigs import Rig
from mapctl.runtime.file_jobs import FileJob, FileResult, try_job


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
    licence: str = ""
    """Licence of the results, beside that of each motion; for formats that keep one."""
    on_read: Callable[[Path, Motion, Rig | None], None] | None = None
    """Function called with each file, its motion and its rig, in that process: to print what is doubtful."""

    def __call__(self, job: FileJob) -> FileResult:
        """Denoise one file and write the result; errors are in what is returned, except DiskFullError."""
        torch.set_num_threads(1)
        return try_job(job, self._denoise)

    def _denoise(self, job: FileJob) -> tuple[int, float]:
        unit = None if self.rig is None else self.rig.metres_per_unit
        motion, missing = formats.load_with_missing(job.source, metres_per_unit=unit)
        if self.on_read is not None:
            self.on_read(job.source, motion, self.rig)
        masks = masks_from_missing(motion, missing)
        inbetweener = None if self.load_inbetweener is None else _load_once(self.load_inbetweener)
        denoiser = _load_once(self.load)
        done = denoise(motion, denoiser, inbetweener=inbetweener, masks=masks, settings=self.settings, rig=self.rig)
        done = replace(done, motion=replace(done.motion, licence=motion.licence))
        job.out.parent.mkdir(parents=True, exist_ok=True)
        if self.after is not None:
            self.after(job, done)
        licence = join_licences((self.licence, motion.licence))
        formats.save(replace(done.motion, licence=licence), job.out)
        return done.motion.num_frames, done.seconds


_Network = TypeVar("_Network", Denoiser, Inbetweener)
_LOADED: dict[str, Any] = {}  # the denoiser and the in-betweener that this process loaded last


def _load_once(load: Callable[[], _Network]) -> _Network:
    key = repr(load)
    if key not in _LOADED:
        if len(_LOADED) > 1:
            _LOADED.clear()
        _LOADED[key] = load()
    return _LOADED[key]
