"""`mapctl denoise FOLDER -o FOLDER`: every motion below a folder, resumable, failures listed at the end."""

from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from mapctl.commands.shared import options, outputs
from mapctl.commands.shared.resumption import telling_what_is_finished
from mapctl.errors import RequestError
from mapctl.runtime.progress import bar

if TYPE_CHECKING:
    from controllers.denoising.batch import Done, Job
    from controllers.denoising.result import Denoised
    from mapctl.commands.denoise import Denoise

_NOT_ALL_HOLDS = 3


def run(given: "Denoise") -> int:
    """Check, denoise what is not done yet, list what failed."""
    jobs, there = jobs_of(given)
    import priors
    from controllers.denoising.batch import Cleaner, over_cluster, over_processes

    priors.load_denoiser(given.denoiser)  # a typing error is said once, now
    load = partial(priors.load_denoiser, given.denoiser)
    after = None if given.report is None else WriteReport(given, given.report)
    cleaner = Cleaner(load, given.settings(), options.read_rig(given.rig), after)
    if given.cluster is not None:
        ended = over_cluster(jobs, cleaner, address=given.cluster, workers=given.jobs)
    else:
        ended = over_processes(jobs, cleaner, processes=given.jobs)
    failed: list[Done] = []
    frames, seconds = 0, 0.0
    again = "" if given.again else "the same command goes on with the others"
    counted = telling_what_is_finished(len(jobs), "files", again)
    with bar("denoising", quiet=given.quiet) as progress, counted as finished:
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
    return _NOT_ALL_HOLDS if failed else 0


def jobs_of(given: "Denoise") -> tuple[list["Job"], int]:
    """What there is to do, and how many files are done already; RequestError for what folders do not take."""
    from controllers.denoising.batch import Job
    from mapctl import formats

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
    jobs = [Job(path, given.out / _written(path.relative_to(given.source))) for path in sources]
    names: dict[Path, Path] = {}
    for job in jobs:
        if (other := names.setdefault(job.out, job.source)) != job.source:
            raise RequestError(f"{other} and {job.source} would both become {job.out}")
    left = jobs if given.again else [job for job in jobs if not job.out.exists()]
    return left, len(jobs) - len(left)


def _written(path: Path) -> Path:
    """The same name, with an ending that can be written."""
    from mapctl import formats

    return path if path.suffix.lower() in formats.WRITERS else path.with_suffix(".bvh")


@dataclass(frozen=True)
class WriteReport:
    """Writes a report for each file, in the process that cleaned it."""

    given: "Denoise"
    """The command."""
    folder: Path
    """Where reports go, by the names of the results."""

    def __call__(self, job: "Job", done: "Denoised") -> None:
        """One report."""
        from mapctl import report

        place = (self.folder / job.out.relative_to(self.given.out)).with_suffix(".json")
        place.parent.mkdir(parents=True, exist_ok=True)
        report.write(self.given.as_report(done), place)
