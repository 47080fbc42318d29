"""`mapctl denoise FOLDER -o FOLDER`: every motion below a folder, resumable, failures listed at the end."""

from dataclasses import dataclass
from functools import partial
from pathlib import Path

import priors
from controllers.denoising.batch import FileDenoiser
from controllers.denoising.denoise import DenoiseSettings
from controllers.denoising.result import DenoiseSolution
from mapctl import report
from mapctl.commands.denoise import Denoise
from mapctl.commands.shared import folders, inputs, licensing, outputs, results
from mapctl.errors import RequestError
from mapctl.runtime.file_jobs import FileJob, run_over_cluster, run_over_processes
from priors import licences


def run(command: Denoise, settings: DenoiseSettings) -> int:
    """Check, denoise what is not done yet, list what failed."""
    jobs, skipped = collect_jobs(command)
    priors.load_denoiser(command.denoiser)  # a typing error is reported once, now
    load = partial(priors.load_denoiser, priors.add_set(command.denoiser))
    load_inbetweener = partial(priors.load_inbetweener, priors.add_set(command.inbetweener or "transformer"))
    load_inbetweener()
    used = dict(licences.find_used_licences())  # what the processes use, and they do not record
    after = None if command.report is None else ReportWriter(command, command.report, used)
    licence = licensing.format_used_licences()
    rig, on_read = inputs.read_rig(command.rig, command), None if command.quiet else inputs.print_doubts
    file_denoiser = FileDenoiser(load, settings, load_inbetweener, rig, after, licence, on_read)
    if command.cluster is not None:
        ended = run_over_cluster(jobs, file_denoiser, address=command.cluster, workers=command.jobs)
    else:
        ended = run_over_processes(jobs, file_denoiser, processes=command.jobs)
    found = folders.await_results(ended, len(jobs), label="denoising", again=command.again, quiet=command.quiet)
    return folders.conclude(command.out, found, skipped, done="denoised", quiet=command.quiet)


def collect_jobs(command: Denoise) -> tuple[list[FileJob], int]:
    """Collect the jobs, and the number of files done already; RequestError for options that folders do not take."""
    for name in ("mask", "video", "prior", "causal", "strict"):
        if getattr(command, name):
            raise RequestError(f"--{name} is for single files; {command.source} is a folder")
    if command.jobs < 1:
        raise RequestError(f"--jobs must be at least 1, got {command.jobs}")
    if command.cluster not in (None, "local") and command.jobs != 1:
        raise RequestError(f"--jobs is for this machine; the cluster at {command.cluster} has workers of its own")
    if command.report is not None:
        outputs.check_folder(command.report)
    return folders.collect_jobs(command.source, command.out, again=command.again)


@dataclass(frozen=True)
class ReportWriter:
    """Writer of a report for each file, in the process that denoised it."""

    command: Denoise
    """The command."""
    folder: Path
    """Folder of the reports, named as the results."""
    used: dict[str, str]
    """Licences of the models; that of the motion joins them."""

    def __call__(self, job: FileJob, done: DenoiseSolution) -> None:
        """Write one report."""
        path = (self.folder / job.out.relative_to(self.command.out)).with_suffix(".json")
        path.parent.mkdir(parents=True, exist_ok=True)
        own = done.motion.licence
        used = self.used | ({str(job.source): licences.shorten_licence(own)} if own else {})
        told = results.build_report("denoise", self.command, done)
        report.write_report(told | licences.describe_licences(used), path)
