"""What a training run is trained on: the corpus of a folder, split, and the files that were left out, said."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from mapctl.errors import RequestError
from mapctl.features import PRIOR_FPS
from mapctl.formats.atomic import write_text
from priors import checkpoints
from priors.licences import OF_DATA, check_not_laxer, find_strictest
from priors.training.augmentation.splices import Splices, add_splices
from priors.training.corpus import Corpus, SkippedFile, Split, join_made, keep_share, read_corpus, split_corpus
from priors.training.mocap.made import require_made
from priors.weight_sets import add_set, means_bundled, name_for_records

Progress = Callable[[str], None]
"""Called with one line of news."""

_MOST_NAMED = 5
_SKIPPED_LIST = "skipped.txt"


@dataclass(frozen=True)
class DataSource:
    """Where motion comes from."""

    data: Path
    """Folder of BVH files, searched below."""
    run: Path
    """Run folder: features are kept there, and the list of what was left out."""
    match: str = ""
    """Regular expression that a file's path below `data` must contain."""
    skip_first: bool = False
    """Drop frame 0 of every clip (the T-pose of CMU takes)."""
    strict: bool = False
    """Refuse a folder with a file that cannot be used, rather than leave the file out."""
    cuts: Path | None = None
    """Table of the frames of each file that are motion; those named `Frame_Cuts.csv` in the folder are found."""
    level: bool = False
    """Put every clip on the canonical body and a level floor."""
    seed: int = 1
    """Seed of the split into training and validation clips."""
    share: float = 1.0
    """Share of the training clips that are used (see `keep_share`)."""
    made: Path | None = None
    """Folder of clips that a model made, with their list (see `find_made`), which are trained on as well."""
    splices: Splices = field(default_factory=Splices)
    """Splices of the clips to train on, which are trained on as well."""
    licence: str = OF_DATA
    """Licence of the weights."""
    teachers: tuple[str, ...] = ()
    """Models, bundled or trained, that these weights begin with or learn from."""


def gather(source: DataSource, *, progress: Progress, warn: Progress) -> tuple[Corpus, Split]:
    """The corpus and its parts; `warn` gets a line on files that were left out, RUN/skipped.txt has them all.

    RequestError where nothing is left, what is left cannot be split, or, if that is asked for, a file cannot be used;
    and where the licence of a teacher, or of a clip that a model made, is stricter than that of the weights.
    """
    check_not_laxer(source.licence, {name: _read_card(name).licence for name in source.teachers})

    def news(done: int, total: int) -> None:
        if done % 200 == 0 or done == total:
            progress(f"read {done} of {total} clips")

    corpus = read_corpus(
        source.data,
        match=source.match,
        cache=source.run / "cache",
        skip_first=source.skip_first,
        cuts=source.cuts,
        level=source.level,
        progress=news,
    )
    if source.made is not None:
        corpus = join_made(corpus, _read_made(source, source.made))
    if corpus.made.licences:
        check_not_laxer(source.licence, {"a clip that a model made": find_strictest(corpus.made.licences)})
    if source.strict and corpus.skipped:
        raise RequestError(f"--strict-data: {_list_skipped(corpus.skipped, source.data)}")
    corpus, parts = keep_share(corpus, split_corpus(corpus, source.seed), source.share, source.seed)
    if source.splices.count:
        train = add_splices(replace(parts.train, made=corpus.made), source.splices, source.run / "cache")
        corpus, parts = replace(corpus, made=train.made), replace(parts, train=train)
    if corpus.skipped:
        rest = f"; all are in {source.run / _SKIPPED_LIST}" if len(corpus.skipped) > _MOST_NAMED else ""
        of = len(corpus.names) + len(corpus.skipped)
        warn(f"left out {len(corpus.skipped)} of {of} files: {_list_skipped(corpus.skipped, source.data)}{rest}")
        write_text(source.run / _SKIPPED_LIST, "".join(f"{file.name}: {file.reason}\n" for file in corpus.skipped))
    for line in corpus.cuts:
        progress(f"frames by {line}")
    for line in corpus.made.told:
        progress(f"made, not captured: {line}")
    size = f"{len(corpus.names)} clips, {len(corpus.features)} frames"
    progress(f"{size}; training on {len(parts.train.names)}{_describe_held_out(parts)}")
    return corpus, parts


def _read_made(source: DataSource, folder: Path) -> Corpus:
    """Those clips of a folder that a list in it tells as made; RequestError where there are none."""
    made = read_corpus(folder, match="", cache=source.run / "cache", level=source.level)
    require_made(made.made, folder)
    return made


def describe_selection(corpus: Corpus) -> dict[str, dict[str, str] | list[str]]:
    """For a card's data: the files that were left out and why, and the tables that say which frames are motion, and
    clips that a model made; nothing where there are none."""
    found: dict[str, dict[str, str] | list[str]] = {}
    if corpus.skipped:
        found["skipped"] = {file.name: file.reason for file in corpus.skipped}
    if corpus.cuts:
        found["cuts"] = list(corpus.cuts)
    if corpus.made.told:
        found["made"] = list(corpus.made.told)
    return found


def _list_skipped(skipped: Sequence[SkippedFile], data: Path) -> str:
    """The first few with their reasons, and how many more there are."""
    named = "; ".join(f"{data / file.name}: {file.reason}" for file in skipped[:_MOST_NAMED])
    return named + (f"; and {len(skipped) - _MOST_NAMED} more" if len(skipped) > _MOST_NAMED else "")


def _describe_held_out(parts: Split) -> str:
    """What is held out where that is no whole clip."""
    if parts.validation is not parts.test:
        return ""
    return f", without {parts.test.names[0]} (frames at {PRIOR_FPS} fps), which is held out"


def find_split_seed(init: str | None, own: int, given: int | None = None) -> int:
    """Find the seed by which clips were kept from the model that training begins with; `own` without one.

    With another seed the run would train on what its measures hold out: RequestError where one is `given`.
    """
    if init is None:
        return own if given is None else given
    found = int(checkpoints.load(checkpoints.locate(init))[1].data.get("split_seed", own))
    if given not in (None, found):
        raise RequestError(f"{init} has clips kept from it by seed {found}: begin with it without --split-seed {given}")
    return found


def name_origin(init: str) -> str:
    """Name the model that training begins with, for a card: a bundled one with its set; INIT where it is no other's."""
    return add_set(init) if means_bundled(init) else "INIT"


def describe_origin(init: str | None) -> dict[str, dict[str, str]]:
    """For a card's data: the model that training began with, and its licence; nothing without one."""
    if init is None:
        return {}
    return {"init": {"name": name_for_records(init), "licence": _read_card(init).licence}}


def _read_card(name: str) -> checkpoints.Card:
    return checkpoints.read_card(checkpoints.locate(name).with_suffix(".json"))
