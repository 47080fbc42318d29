"""`mapctl convert FOLDER FOLDER`: every motion below a folder, resumable, failures listed at the end."""

from dataclasses import dataclass, replace
from time import perf_counter

from mapctl import formats
from mapctl.commands.convert import Convert
from mapctl.commands.convert.steps import Conversion
from mapctl.commands.shared import folders
from mapctl.errors import RequestError
from mapctl.runtime.file_jobs import FileJob, FileResult, run_over_processes, try_job


@dataclass(frozen=True)
class FileConverter:
    """Converter of single files, cheap to send to a process."""

    conversion: Conversion
    """What is to be done with each."""

    def __call__(self, job: FileJob) -> FileResult:
        """Convert one file and write the result; errors are in what is returned, except DiskFullError."""
        return try_job(job, self._convert)

    def _convert(self, job: FileJob) -> tuple[int, float]:
        start = perf_counter()
        # Of other files than these the rate is in the file.
        fps_in = self.conversion.fps_in if job.source.suffix.lower() == ".amc" else None
        motion = replace(self.conversion, fps_in=fps_in).convert(job.source).motion
        job.out.parent.mkdir(parents=True, exist_ok=True)
        formats.save(motion, job.out)
        return motion.num_frames, perf_counter() - start


def run(command: Convert) -> int:
    """Check, convert what is not done yet, list what failed."""
    if command.report is not None:
        raise RequestError("--report is on one file; a folder has none")
    if command.jobs < 1:
        raise RequestError(f"--jobs must be at least 1, got {command.jobs}")
    ending = command.to
    if ending is not None:
        ending = ending.lower() if ending.startswith(".") else f".{ending.lower()}"
        formats.check_ending(f"a{ending}")
    converter = FileConverter(Conversion.of(command))
    jobs, skipped = folders.collect_jobs(command.source, command.out, again=command.again, ending=ending)
    ended = run_over_processes(jobs, converter, processes=command.jobs)
    found = folders.await_results(ended, len(jobs), label="converting", again=command.again, quiet=command.quiet)
    return folders.conclude(command.out, found, skipped, done="converted", quiet=command.quiet)
