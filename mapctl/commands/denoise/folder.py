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


def run(given: Denoise, settings: DenoiseSettings) -> int:
    """Check, denoise what is not done yet, list what failed."""
    jobs, there = collect_jobs(given)
    priors.load_denoiser(given.denoiser)  # a typing error is said once, now
    load = partial(priors.load_denoiser, given.denoiser)
    after = None if given.report is None else ReportWriter(given, given.report)
    cleaner = FileDenoiser(load, settings, inputs.read_rig(given.rig), after)
    if given.cluster is not None:
        ended = run_over_cluster(jobs, cleaner, address=given.cluster, workers=given.jobs)
    else:
        ended = run_over_processes(jobs, cleaner, processes=given.jobs)
    failed: list[FileResult] = []
    frames, seconds = 0, 0.0
    again = "" if given.again else "the same command goes on with the others"
    counted = explain_progress(len(jobs), "files", again)
    with show_progress("denoising", quiet=given.quiet) as progress, counted as finished:
        for number, done in enumerate(ended, start=1):
            failed += [done] if done.error else []
            frames, seconds = frames + done.frames, seconds + done.seconds
            finished(number)
            if progress is not None:
                progress(number, len(jobs))
    if not given.quiet:
        cost = f", {1000 * seconds / frames:.1f} ms a frame" if frames else ""
        print(f"{given.out}: {len(jobs) - len(failed)} denoised{cost}, {there} there already, {len(failed)} failed")
    for done in sorted(failed, key=lambda done: done.job.source):
        # A reader's message names its file already.
        text = done.error if str(done.job.source) in done.error else f"{done.job.source}: {done.error}"
        print(f"failed: {text}")
    return exit_status.NOT_SATISFIED if failed else 0


def collect_jobs(given: Denoise) -> tuple[list[FileJob], int]:
    """What there is to do, and how many files are done already; RequestError for what folders do not take."""
    for name in ("mask", "plot", "video", "prior", "causal", "strict"):
        if getattr(given, name):
            raise RequestError(f"--{name} is for single files; {given.source} is a folder")
    if given.jobs < 1:
        raise RequestError(f"--jobs must be at least 1, got {given.jobs}")
    if given.cluster not in (None, "local") and given.jobs != 1:
        raise RequestError(f"--jobs is for this machine; the cluster at {given.cluster} has workers of its own")
    outputs.check_folder(given.out)
    if given.report is not None:
        outputs.check_folder(given.report)
    inside = given.out.resolve()
    sources = sorted(
        path
        for path in given.source.rglob("*")
        if path.suffix.lower() in formats.READERS and inside not in path.resolve().parents
    )
    if not sources:
        raise RequestError(f"no {' or '.join(formats.READERS)} below {given.source}")
    jobs = [FileJob(path, given.out / _choose_output_name(path.relative_to(given.source))) for path in sources]
    names: dict[Path, Path] = {}
    for job in jobs:
        if (other := names.setdefault(job.out, job.source)) != job.source:
            raise RequestError(f"{other} and {job.source} would both become {job.out}")
    left = jobs if given.again else [job for job in jobs if not job.out.exists()]
    return left, len(jobs) - len(left)


def _choose_output_name(path: Path) -> Path:
    """The same name, with an ending that can be written."""
    return path if path.suffix.lower() in formats.WRITERS else path.with_suffix(".bvh")


@dataclass(frozen=True)
class ReportWriter:
    """Writes a report for each file, in the process that cleaned it."""

    given: Denoise
    """The command."""
    folder: Path
    """Where reports go, by the names of the results."""

    def __call__(self, job: FileJob, done: DenoiseSolution) -> None:
        """One report."""
        place = (self.folder / job.out.relative_to(self.given.out)).with_suffix(".json")
        place.parent.mkdir(parents=True, exist_ok=True)
        report.write_report(results.build_report("denoise", self.given, done), place)
