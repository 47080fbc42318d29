"""What is to be trained in the folder of a set, and what was trained there before."""

import hashlib
import json
import os
import shlex
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from mapctl.errors import RequestError
from mapctl.formats.atomic import write_text
from priors.training import run_files
from priors.training.bundled.models import DATA, MADE, RUN, BundledModel
from priors.training.bundled.weights import is_finished
from priors.weight_sets import write_path

RECORD, LOCK, CACHE = "all.json", ".lock", "cache"


@dataclass(frozen=True)
class Job:
    """One model in its run folder."""

    model: BundledModel
    """Which."""
    run: Path
    """Run folder, OUT/NAME."""
    words: tuple[str, ...]
    """What is typed to train it from scratch."""

    @property
    def finished(self) -> bool:
        """Whether there is nothing left to do."""
        return is_finished(self.run)

    def resume(self) -> list[str]:
        """What is typed to begin it, or to go on with it. All models share the cache of the clips, where the system
        lets links be made (Windows asks for a right); else each makes its own."""
        if not (self.run / CACHE).exists():
            self.run.mkdir(parents=True, exist_ok=True)
            (self.run.parent / CACHE).mkdir(exist_ok=True)
            with suppress(OSError):
                (self.run / CACHE).symlink_to(Path("..") / CACHE, target_is_directory=True)
        return [*self.words, "--resume"] if run_files.has_checkpoint(self.run) else list(self.words)


def make_jobs(
    models: Sequence[BundledModel], data: Path, out: Path, minutes: float, *, made: Path | None = None
) -> list[Job]:
    """Make them in the order of the table; `made` is the folder of clips that a model made, where a command names one.
    RequestError where one needs another that is not among them or there."""
    names = {model.name for model in models}
    for model in models:
        for need in model.needs.values():
            if need not in names and not is_finished(out / need):
                raise RequestError(f"{model.name} needs {need}, which is not in {out}: add it to --only")
    folders = {DATA: data, MADE: made}
    return [Job(model, out / model.name, _type(model, folders, out, minutes)) for model in models]


def _type(model: BundledModel, folders: Mapping[Path, Path | None], out: Path, minutes: float) -> tuple[str, ...]:
    """The command of the card, with folders in it, and what changes no weight: licence and limit."""
    named = {str(name): str(folder) for name, folder in {**folders, RUN: out / model.name}.items() if folder}
    words = [named.get(word, word) for word in shlex.split(model.command)]
    for option, need in model.needs.items():
        at = words.index(option) if option in words else len(words)
        words[at : at + 2] = [option, write_path(out / need)]
    ends_anywhere = model.recipe.until_flat is not None or not model.recipe.falls
    limit = ("--minutes", f"{minutes:g}") if ends_anywhere else ()
    return (*words, "--licence", model.recipe.licence, *limit)


@dataclass
class Record:
    """OUT/all.json: which clips there were, and how each model was begun, so that nothing else goes on with it."""

    out: Path
    """Folder of the set."""
    clips: dict[str, Any]
    """How many there are, and a hash of their names and sizes."""
    models: dict[str, dict[str, Any]] = field(default_factory=dict)
    """By name the command, and the hashes of the models that it needed."""

    @staticmethod
    def read(out: Path, data: Path, jobs: Sequence[Job]) -> "Record":
        """Read what there is, and compare it with what is wanted. RequestError for a folder that is something else, for
        other clips, and for a model that was begun in another way."""
        record, path = Record(out, _describe_clips(data)), out / RECORD
        if not path.exists():
            if out.exists() and any(out.iterdir()):
                raise RequestError(f"{out} is not empty, and was not begun by mapctl train all; choose another folder")
            return record
        try:
            found = json.loads(path.read_text(encoding="utf-8"))
            clips, record.models = dict(found["clips"]), {name: dict(row) for name, row in found["models"].items()}
        except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
            raise RequestError(f"{path} cannot be read ({error}); choose another folder") from error
        if clips != record.clips:
            raise RequestError(f"{out} was begun with other clips than {data} holds; choose another folder")
        for job in jobs:
            record._check(job)
        return record

    def write(self) -> None:
        """Write it."""
        self.out.mkdir(parents=True, exist_ok=True)
        write_text(self.out / RECORD, json.dumps({"clips": self.clips, "models": self.models}, indent=1) + "\n")

    def note(self, job: Job) -> None:
        """A model begins or goes on. RequestError where it was begun with others than those that it needs now."""
        self._check(job)
        self.models[job.model.name] = {"command": job.model.command, "needs": self._hash_needs(job)}
        self.write()

    def _check(self, job: Job) -> None:
        if not (job.finished or run_files.has_checkpoint(job.run)):
            return
        known = self.models.get(job.model.name)
        if known is None:
            raise RequestError(f"{job.run} holds a run that mapctl train all did not begin; choose another folder")
        advice = f"delete {job.run} to train it anew, or choose another folder"
        if known.get("command") != job.model.command:
            then, now = known.get("command"), job.model.command
            raise RequestError(f"{job.run} was begun as: {then}; asked for: {now}; {advice}")
        hashes = self._hash_needs(job)
        for need, before in known.get("needs", {}).items():
            if hashes.get(need) != before:
                raise RequestError(f"{job.run} was trained with another {need} than {self.out / need}; {advice}")

    def _hash_needs(self, job: Job) -> dict[str, str]:
        runs = {need: self.out / need / "model.safetensors" for need in job.model.needs.values()}
        return {need: hashlib.sha256(file.read_bytes()).hexdigest() for need, file in runs.items() if file.is_file()}


def _describe_clips(data: Path) -> dict[str, Any]:
    """RequestError where there are none."""
    if not data.is_dir():
        raise RequestError(f"{data} is not a folder of BVH files")
    rows = [
        f"{(Path(folder) / name).relative_to(data).as_posix()} {(Path(folder) / name).stat().st_size}"
        for folder, _, names in os.walk(data)
        for name in names
        if name.lower().endswith(".bvh")
    ]
    if not rows:
        raise RequestError(f"no .bvh below {data}")
    return {"files": len(rows), "hash": hashlib.sha256("\n".join(sorted(rows)).encode()).hexdigest()[:16]}


@contextmanager
def lock_folder(out: Path) -> Iterator[int | None]:
    """Keep others from training in the folder. RequestError where they do.

    The lock's file descriptor is for the processes that train, which hold it as long as they live; None where the
    system has no such locks.
    """
    if find_spec("fcntl") is None:
        yield None
        return
    import fcntl

    out.mkdir(parents=True, exist_ok=True)
    with (out / LOCK).open("w") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            raise RequestError(f"{out} is being trained in by another process") from error
        yield file.fileno()
