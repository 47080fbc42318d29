"""Commands over folders: every motion below one, in processes (joblib) or on a cluster (ray); resumable.

No file's failure stops another, and failures are listed at the end; a full disk stops all.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, fields
from functools import partial
from pathlib import Path
from typing import Any

from joblib import Parallel, delayed

from mapctl import formats
from mapctl.commands.shared import outputs
from mapctl.commands.shared.command import NOT_SATISFIED
from mapctl.commands.shared.options import FolderOptions
from mapctl.errors import DiskFullError, MapctlError, RequestError

Work = Callable[[Path, Path], tuple[int, float]]
"""Function from a motion file and the file to write to the frames and seconds of compute, cheap to send to a process.
It writes the file last: one that exists is complete."""


@dataclass(frozen=True)
class _Result:
    """Outcome of a file: why there is no result, or frames and seconds of compute."""

    source: Path
    error: str = ""
    frames: int = 0
    seconds: float = 0.0


def refuse_options(options: FolderOptions, source: Path, *others: str) -> None:
    """Raise RequestError where one of the options for folders, or of `others`, is given with a file."""
    for field in fields(options):
        if field.name in ("jobs", "again", *others) and getattr(options, field.name) != field.default:
            raise RequestError(f"--{field.name} is for folders; {source} is a file")


def run_folder(
    source: Path,
    out: Path,
    work: Work,
    options: FolderOptions,
    *,
    label: str,
    done: str,
    ending: str | None = None,
    cluster: str | None = None,
) -> int:
    """Do the work for every motion below a folder, in processes of this machine or on a `cluster`, and print how many
    files are `done` (a word for it), at which cost, and which failed; return the exit status.

    Results have the same names in sub-folders of the same names, with an `ending` if it is given, else their own or
    .bvh; those that exist already are left out unless `options` want them again. RequestError where there is no motion,
    where two results would have one name, and where a result would be written over a motion that is there to be read.
    """
    processes, again = options.jobs, options.again
    if processes < 1:
        raise RequestError(f"--jobs must be at least 1, got {processes}")
    jobs = _collect_jobs(source, out, ending)
    left = jobs if again else [job for job in jobs if not job[1].exists()]
    run = partial(_run_job, work)
    if cluster is not None:
        ended = _run_over_cluster(left, run, address=cluster, workers=processes)
    elif processes == 1:
        ended = map(run, left)
    else:
        ended: Any = Parallel(n_jobs=processes, return_as="generator_unordered")(delayed(run)(job) for job in left)
    results: list[_Result] = []
    counted = outputs.explain_progress(len(left), "files", "" if again else "the same command goes on with the others")
    with outputs.show_progress(label, quiet=options.quiet) as progress, counted as finished:
        for result in ended:
            results.append(result)
            finished(len(results))
            if progress is not None:
                progress(len(results), len(left))
    failed = sorted((result for result in results if result.error), key=lambda result: result.source)
    if not options.quiet:
        frames, seconds = sum(result.frames for result in results), sum(result.seconds for result in results)
        cost = f", {1000 * seconds / frames:.1f} ms a frame" if frames else ""
        counts = f"{len(jobs) - len(left)} there already, {len(failed)} failed"
        print(f"{out}: {len(results) - len(failed)} {done}{cost}, {counts}")
    for result in failed:
        # A reader's message names its file already.
        named = str(result.source) in result.error
        print(f"failed: {result.error if named else f'{result.source}: {result.error}'}")
    return NOT_SATISFIED if failed else 0


def _collect_jobs(source: Path, out: Path, ending: str | None) -> list[tuple[Path, Path]]:
    outputs.check_folder(out)
    inside = out.resolve()
    if inside == source.resolve():
        raise RequestError(f"{out} is the folder that is read; choose another one for the results")
    sources = sorted(
        path
        for path in source.rglob("*")
        if path.suffix.lower() in formats.IN_FOLDERS and inside not in path.resolve().parents
    )
    if not sources:
        raise RequestError(f"no {' or '.join(formats.IN_FOLDERS)} below {source}")
    given, taken, jobs = {path.resolve() for path in sources}, dict[Path, Path](), list[tuple[Path, Path]]()
    for path in sources:
        own = path.suffix if path.suffix.lower() in formats.WRITERS and path.suffix.lower() != ".fbx" else ".bvh"
        result = out / path.relative_to(source).with_suffix(ending or own)
        if ending is None:
            formats.check_ending(result)
        if (other := taken.setdefault(result, path)) != path:
            raise RequestError(f"{other} and {path} would both become {result}")
        if result.resolve() in given:
            raise RequestError(f"{result} would be written over; choose another folder than {out}")
        jobs.append((path, result))
    return jobs


def _run_job(work: Work, job: tuple[Path, Path]) -> _Result:
    source, out = job
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        return _Result(source, "", *work(source, out))
    except DiskFullError:
        raise  # no other file could be written
    except (MapctlError, OSError) as error:
        return _Result(source, " ".join(str(error).split()))
    except Exception as error:
        return _Result(source, f"{type(error).__name__}: {' '.join(str(error).split())}")


def _run_over_cluster(
    jobs: Sequence[tuple[Path, Path]], run: Callable[[tuple[Path, Path]], _Result], *, address: str, workers: int
) -> Iterator[_Result]:
    """Yield results as jobs end, on a ray cluster; `local` starts one of so many workers on this machine. All machines
    must see the files under the same paths. RequestError where ray is not installed or the cluster does not answer.
    """
    try:
        import ray
    except ImportError as error:
        raise RequestError(f"clusters need ray ({error}): pip install 'mapctl[cluster]'") from error
    where: dict[str, Any] = {"address": address}
    if address == "local":
        where = {"num_cpus": workers, "include_dashboard": False}
    try:
        ray.init(**where, log_to_driver=False, configure_logging=False)
    except (ConnectionError, RuntimeError, ValueError) as error:
        raise RequestError(f"no ray cluster at {address} ({' '.join(str(error).split())})") from error
    try:

        def do(job: tuple[Path, Path]) -> _Result:
            return run(job)

        task = ray.remote(num_cpus=1, max_retries=2)(do)
        waiting = {task.remote(job): job for job in jobs}
        while waiting:
            ready, _ = ray.wait(list(waiting), num_returns=1)
            source, _ = waiting.pop(ready[0])
            try:
                yield ray.get(ready[0])
            except ray.exceptions.RayError as error:
                yield _Result(source, " ".join(str(error).split())[:200])
    finally:
        ray.shutdown()
