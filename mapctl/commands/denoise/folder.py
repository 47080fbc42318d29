"""`mapctl denoise FOLDER -o FOLDER`: every motion below a folder, resumable, failures listed at the end."""

from dataclasses import dataclass
from functools import partial
from pathlib import Path

import priors
from controllers.denoising.batch import FileDenoiser, FileJob, FileResult, run_over_cluster, run_over_processes
from controllers.denoising.denoise import DenoiseSettings
from controllers.denoising.result import DenoiseSolution
from mapctl import formats, report
from mapctl.commands.denoise import Denoise
from mapctl.commands.shared import exit_status, inputs, outputs, results
from mapctl.commands.shared.progress_bar import show_progress
from mapctl.commands.shared.resumption import explain_progress
from mapctl.errors import RequestError


def run(command: Denoise, settings: DenoiseSettings) -> int:
    """Check, denoise what is not done yet, list what failed."""
    jobs, skipped = collect_jobs(command)
    priors.load_denoiser(command.denoiser)  # a typing error is reported once, now
    load = partial(priors.load_denoiser, command.denoiser)
    load_inbetweener = partial(priors.load_inbetweener, command.inbetweener or "transformer")
    load_inbetweener()
    after = None if command.report is None else ReportWriter(command, command.report)
    file_denoiser = FileDenoiser(load, settings, load_inbetweener, inputs.read_rig(command.rig), after)
    if command.cluster is not None:
        ended_files = run_over_cluster(jobs, file_denoiser, address=command.cluster, workers=command.jobs)
    else:
        ended_files = run_over_processes(jobs, file_denoiser, processes=command.jobs)
    failed: list[FileResult] = []
    frames, seconds = 0, 0.0
    again = "" if command.again else "the same command goes on with the others"
    counted = explain_progress(len(jobs), "files", again)
    with show_progress("denoising", quiet=command.quiet) as progress, counted as finished:
        for number, done in enumerate(ended_files, start=1):
            failed += [done] if done.error else []
            frames, seconds = frames + done.frames, seconds + done.seconds
            finished(number)
            if progress is not None:
                progress(number, len(jobs))
    if not command.quiet:
        cost = f", {1000 * seconds / frames:.1f} ms a frame" if frames else ""
        print(f"{command.out}: {len(jobs) - len(failed)} denoised{cost}, {skipped} there already, {len(failed)} failed")
    for done in sorted(failed, key=lambda done: done.job.source):
        # A reader's message names its file already.
        text = done.error if str(done.job.source) in done.error else f"{done.job.source}: {done.error}"
        print(f"failed: {text}")
    return exit_status.NOT_SATISFIED if failed else 0


def collect_jobs(command: Denoise) -> tuple[list[FileJob], int]:
    """Collect the jobs, and the number of files done already; RequestError for options that folders do not take."""
    for name in ("mask", "plot", "video", "prior", "causal", "strict"):
        if getattr(command, name):
            raise RequestError(f"--{name} is for single files; {command.source} is a folder")
    if command.jobs < 1:
        raise RequestError(f"--jobs must be at least 1, got {command.jobs}")
    if command.cluster not in (None, "local") and command.jobs != 1:
        raise RequestError(f"--jobs is for this machine; the cluster at {command.cluster} has workers of its own")
    outputs.check_folder(command.out)
    if command.report is not None:
        outputs.check_folder(command.report)
    inside = command.out.resolve()
    sources = sorted(
        path
        for path in command.source.rglob("*")
        if path.suffix.lower() in formats.READERS and inside not in path.resolve().parents
    )
    if not sources:
        raise RequestError(f"no {' or '.join(formats.READERS)} below {command.source}")
    jobs = [FileJob(path, command.out / _choose_output_name(path.relative_to(command.source))) for path in sources]
    names: dict[Path, Path] = {}
    for job in jobs:
        if (other := names.setdefault(job.out, job.source)) != job.source:
            raise RequestError(f"{other} and {job.source} would both become {job.out}")
    left = jobs if command.again else [job for job in jobs if not job.out.exists()]
    return left, len(jobs) - len(left)


def _choose_output_name(path: Path) -> Path:
    """Choose the same name, with an ending that can be written."""
    return path if path.suffix.lower() in formats.WRITERS else path.with_suffix(".bvh")


@dataclass(frozen=True)
class ReportWriter:
    """Writer of a report for each file, in the process that denoised it."""

    command: Denoise
    """The command."""
    folder: Path
    """Folder of the reports, named as the results."""

    def __call__(self, job: FileJob, done: DenoiseSolution) -> None:
        """Write one report."""
        path = (self.folder / job.out.relative_to(self.command.out)).with_suffix(".json")
        path.parent.mkdir(parents=True, exist_ok=True)
        report.write_report(results.build_report("denoise", self.command, done), path)
