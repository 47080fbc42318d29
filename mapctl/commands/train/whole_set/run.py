"""`mapctl train all`: what is asked for is checked, trained in order of dependence, gathered and told."""

import math
import shlex
from collections.abc import Callable, Sequence
from pathlib import Path

from mapctl.commands.shared import exit_status, options, outputs
from mapctl.commands.shared.resumption import explain_end
from mapctl.commands.train.options import check_licence, check_pattern, check_share
from mapctl.commands.train.progress import print_line, warn
from mapctl.commands.train.whole_set import TrainAll, data_scaling, summary
from mapctl.commands.train.whole_set.licensing import license_models
from mapctl.commands.train.whole_set.plan import Job, Record, lock_folder, make_jobs
from mapctl.commands.train.whole_set.workers import Say, train_jobs
from mapctl.errors import MapctlError, RequestError
from priors.licences import check_not_laxer, find_strictest
from priors.training.bundled import weights
from priors.training.bundled.models import BundledModel, list_models
from priors.training.mocap.made import find_made, require_made


def run(command: TrainAll) -> int:
    """Train, or tell of sets that there are."""
    told = (command.check, command.compare, command.by_motion)
    if command.commands + sum(each is not None for each in told) > 1:
        raise RequestError("--commands, --check, --compare and --by-motion are asked for one at a time")
    if command.out is not None and (command.check is not None or command.compare is not None):
        raise RequestError("--check and --compare print and write nothing: leave out -o")
    if command.check is not None:
        return _check(command.check, command.weights)
    if command.compare is not None:
        if not 0 <= command.within < math.inf:
            raise RequestError(f"--within must be at least 0, got {command.within:g}")
        return summary.print_comparison(*command.compare, percent=command.within)
    if command.by_motion is not None:
        return data_scaling.print_scaling(command.by_motion, command.out)
    options.check_seed(command.seed)
    check_share(command.data_share)
    check_licence(command.licence)
    check_pattern(command.match)
    models = list_models(
        command.weights,
        match=command.match,
        seed=command.seed,
        share=command.data_share,
        with_made=command.made is not None,
    )
    chosen = _choose(models, command.only)
    if command.commands:
        for model in chosen:
            print(f"{model.name}: {model.command}")
        return 0
    return _train(command, chosen)


def _train(command: TrainAll, chosen: Sequence[BundledModel]) -> int:
    if command.data is None or command.out is None:
        raise RequestError("train all needs --data DATA and -o OUT")
    if command.jobs < 1:
        raise RequestError(f"--jobs must be at least 1, got {command.jobs}")
    if not 0 < command.minutes < math.inf:
        raise RequestError(f"--minutes must be positive, got {command.minutes:g}")
    chosen = license_models(command, chosen)
    if command.made is not None:
        _check_made(command.made, chosen[0].recipe.licence)
    jobs = make_jobs(chosen, command.data, command.out, command.minutes, made=command.made)
    record = Record.read(command.out, command.data, jobs)
    outputs.check_folder(command.out)
    with explain_end(lambda: _describe_resumption(command, jobs)), lock_folder(command.out) as lock:
        record.write()

        def start(job: Job) -> list[str]:
            record.note(job)
            return job.resume()

        failed = train_jobs(jobs, command.jobs, start=start, lock=lock, say=_say(command), finish=_finish(command.out))
    return _conclude(command.out, jobs, failed)


def _check_made(folder: Path, licence: str) -> None:
    """RequestError for a folder without made clips, and for clips under a stricter licence than the weights."""
    made = find_made(folder, [file.relative_to(folder).as_posix() for file in folder.rglob("*.bvh")])
    require_made(made, folder)
    check_not_laxer(licence, {f"a clip in {folder}": find_strictest(made.licences)})


def _conclude(out: Path, jobs: Sequence[Job], failed: dict[str, str]) -> int:
    made = [job.model.name for job in jobs if job.finished]
    if made:
        summary.print_set(out / "weights")
        if summary.plot_set(out / "weights", out / "curves.png"):
            print(f"wrote {out / 'weights'} and {out / 'curves.png'}")
    if failed:
        told = "; ".join(f"{name}: {reason}" for name, reason in failed.items())
        raise MapctlError(f"{len(failed)} of {len(jobs)} models are not finished: {told}")
    return 0


def _check(out: Path, of: str) -> int:
    total = summary.print_set(summary.find_weights(out))
    known = {model.name for model in list_models(of)}
    lacking = sorted(known - set(summary.list_names(summary.find_weights(out))))
    if lacking:
        print(f"not there: {', '.join(lacking)} (of the {of} set; --weights chooses)")
    return exit_status.NOT_SATISFIED if lacking or total > weights.MOST_BYTES else 0


def _choose(models: Sequence[BundledModel], only: str | None) -> list[BundledModel]:
    known = [model.name for model in models]
    names = known if only is None else [name.strip() for name in only.split(",")]
    for name in names:
        if name not in known:
            raise RequestError(f"--only is of {', '.join(known)}; got {name!r}")
    return [model for model in models if model.name in names]


def _say(command: TrainAll) -> Say:
    """Lines of the models, with their names before them; with --quiet only what they have against the data."""

    def say(name: str, line: str) -> None:
        if line.startswith("mapctl: "):
            warn(f"{name}: {line.removeprefix('mapctl: ')}")
        elif not command.quiet:
            print_line(f"{name}: {line}")

    return say


def _finish(out: Path) -> Callable[[Job], None]:
    """Copies a model that is finished into the folder of weights."""

    def finish(job: Job) -> None:
        weights.copy_model(job.model, job.run, out / "weights")

    return finish


def _describe_resumption(command: TrainAll, jobs: Sequence[Job]) -> str:
    done = sum(job.finished for job in jobs)
    return f"{done} of {len(jobs)} models are finished; go on with: {shlex.join(command.format_command())}"
