"""Commands over folders: every motion below one, resumable, failures listed at the end."""

from collections.abc import Iterable
from pathlib import Path

from mapctl import formats
from mapctl.commands.shared import outputs
from mapctl.commands.shared.command import NOT_SATISFIED
from mapctl.commands.shared.outputs import explain_progress, show_progress
from mapctl.errors import RequestError
from mapctl.runtime.file_jobs import FileJob, FileResult


def collect_jobs(source: Path, out: Path, *, again: bool, ending: str | None = None) -> tuple[list[FileJob], int]:
    """Collect a job for every motion below a folder, and the number of those done already, which are none if they are
    wanted `again`.

    Results have the same names in sub-folders of the same names, with an `ending` if it is given, else their own or
    .bvh. RequestError where there is no motion, where two results would have one name, and where a result would be
    written over a motion that is there to be read.
    """
    outputs.check_folder(out)
    inside = out.resolve()
    if inside == source.resolve():
        raise RequestError(f"{out} is the folder that is read; choose another one for the results")
    sources = sorted(
        path
        for path in source.rglob("*")
        if path.suffix.lower() in formats.READERS and inside not in path.resolve().parents
    )
    if not sources:
        raise RequestError(f"no {' or '.join(formats.READERS)} below {source}")
    jobs = [FileJob(path, out / _choose_output_name(path.relative_to(source), ending)) for path in sources]
    names: dict[Path, Path] = {}
    for job in jobs:
        if (other := names.setdefault(job.out, job.source)) != job.source:
            raise RequestError(f"{other} and {job.source} would both become {job.out}")
    given = {path.resolve() for path in sources}
    for job in jobs:
        if job.out.resolve() in given:
            raise RequestError(f"{job.out} would be written over; choose another folder than {out}")
    left = jobs if again else [job for job in jobs if not job.out.exists()]
    return left, len(jobs) - len(left)


def _choose_output_name(path: Path, ending: str | None) -> Path:
    """Choose the same name, with an ending that can be written."""
    if ending is not None:
        return path.with_suffix(ending)
    return path if path.suffix.lower() in formats.WRITERS else path.with_suffix(".bvh")


def await_results(ended: Iterable[FileResult], count: int, *, label: str, again: bool, quiet: bool) -> list[FileResult]:
    """Return the results of so many jobs when all have ended, in a bar with this label on a terminal."""
    found: list[FileResult] = []
    then = "" if again else "the same command goes on with the others"
    counted = explain_progress(count, "files", then)
    with show_progress(label, quiet=quiet) as progress, counted as finished:
        for number, done in enumerate(ended, start=1):
            found.append(done)
            finished(number)
            if progress is not None:
                progress(number, count)
    return found


def conclude(out: Path, results: list[FileResult], skipped: int, *, done: str, quiet: bool) -> int:
    """Tell how many files are `done` (a word for it), at which cost, and which failed; return the exit status."""
    failed = [result for result in results if result.error]
    frames, seconds = (sum(values) for values in ([r.frames for r in results], [r.seconds for r in results]))
    if not quiet:
        cost = f", {1000 * seconds / frames:.1f} ms a frame" if frames else ""
        print(f"{out}: {len(results) - len(failed)} {done}{cost}, {skipped} there already, {len(failed)} failed")
    for result in sorted(failed, key=lambda result: result.job.source):
        # A reader's message names its file already.
        source = str(result.job.source)
        print(f"failed: {result.error if source in result.error else f'{source}: {result.error}'}")
    return NOT_SATISFIED if failed else 0
