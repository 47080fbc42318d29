"""Sets of bundled weights, `full` (the default) and `free`, and the licence of a result: the strictest of its models'.

Files of the full set lie in `priors/weights`, those of the free one in `priors/weights/free`. A name such as
`locomotion` is resolved by the set in force; `free/locomotion` and `full/locomotion` always mean the same file. The set
in force is that of the environment variable MAPCTL_WEIGHTS, which reaches processes that are started, too.
"""

import os
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path, PurePath
from typing import Any

from mapctl.errors import CheckpointError, RequestError

SETS = ("full", "free")
"""The sets by name, the default first."""
VARIABLE = "MAPCTL_WEIGHTS"
"""Environment variable that holds the name of the set in force; the default if it is not set, or empty."""
FOLDER_VARIABLE = "MAPCTL_WEIGHTS_FOLDER"
"""Environment variable that names a folder in place of `priors/weights`, with the free set in its sub-folder `free`."""
STAND_INS = {"locomotion-live": "locomotion"}
"""Models by the name of one that a set may lack, because they serve as well: trained on a few minutes of motion, a
density for live control is no smaller than the other."""
_ENDING = ".safetensors"


def find_current_set() -> str:
    """Find the set in force; RequestError where the environment names another than there is."""
    return _check(os.environ.get(VARIABLE) or SETS[0], VARIABLE)


@contextmanager
def use_weights(name: str | None) -> Iterator[None]:
    """Let bundled names mean the models of a set, `free` or `full`, until the block ends; None changes nothing.

    It holds for all threads of this process, and for processes that are started meanwhile. RequestError for a set that
    does not exist.
    """
    before = os.environ.get(VARIABLE)
    if name is not None:
        os.environ[VARIABLE] = _check(name, "the weights")
    try:
        yield
    finally:
        if before is not None:
            os.environ[VARIABLE] = before
        else:
            os.environ.pop(VARIABLE, None)


def _check(name: str, what: str) -> str:
    if name not in SETS:
        raise RequestError(f"{what} must be {' or '.join(reversed(SETS))}, got {name!r}")
    return name


def list_models(weights: str | None = None) -> list[str]:
    """List the names of a set's models, without the set; of the set in force if none is named."""
    return sorted(file.stem for file in _find_folder(weights or find_current_set()).glob(f"*{_ENDING}"))


def split_name(name: str) -> tuple[str, str]:
    """Split a bundled name into its set, that in force where it names none, and the model's name."""
    weights, slash, model = name.partition("/")
    return (weights, model) if slash and weights in SETS else (find_current_set(), name)


def means_bundled(name: str) -> bool:
    """Return whether a name means a bundled model and no file or folder of that name: it names its set, or is that of a
    model of the set in force. A folder of one's own is then `./locomotion`."""
    weights, model = split_name(name)
    return any(_find_model(each, model) for each in ((weights,) if model == name else SETS))


def find_file(name: str) -> Path | None:
    """Find the file of a bundled name, with or without its set, or of what stands in for it; None without either."""
    weights, model = split_name(name)
    found = _find_model(weights, model)
    return None if found is None else _find_folder(weights) / f"{found}{_ENDING}"


def _find_model(weights: str, model: str) -> str | None:
    """Find which model of a set serves under a name: its own, else its stand-in; None where the set has neither."""
    there = list_models(weights)
    return next((each for each in (model, STAND_INS.get(model)) if each in there), None)


def find_set_of(path: Path) -> str | None:
    """Find the set that a file is of; None for files that are not bundled."""
    folder = path.resolve().parent
    return next((weights for weights in SETS if _find_folder(weights).resolve() == folder), None)


def add_set(name: str) -> str:
    """Add its set to a bundled name, so that it means the same file in another process or on another machine, whatever
    set is in force there; other names, and paths, stay."""
    weights, model = split_name(name)
    bare = model == name and _find_model(weights, model) is not None
    return f"{weights}/{name}" if bare else name


def name_for_records(name: str) -> str:
    """Name a model in a card or a list that others read: with its set if it is bundled, else without its folder."""
    return add_set(name) if means_bundled(name) else Path(name).name


def explain_missing(name: str) -> CheckpointError:
    """Explain that a name is neither a file nor bundled, and what there is."""
    weights, model = split_name(name)
    known, others = list_models(weights), [each for each in SETS if each != weights and _find_model(each, model)]
    there = ", ".join(known) or "the bundled (none)"
    if weights == SETS[0] and model == name and not others:
        return CheckpointError(f"no prior {name!r}: neither a file nor one of {there}")
    held = f"they hold {', '.join(known)}" if known else "none are installed"
    other = f"; {others[0]}/{model} is there, under a licence of its own (mapctl info)" if others else ""
    return CheckpointError(f"the {weights} weights have no {model!r}: {held}{other}")


def _find_folder(weights: str) -> Path:
    own = os.environ.get(FOLDER_VARIABLE)
    whole = Path(own) if own else Path(__file__).with_name("weights")
    return whole if weights == SETS[0] else whole / weights


FREE = ("free for any use", "CC0 1.0")
"""Licences of models of the free set, which ask nothing of their users."""
OF_DATA = "that of the training data"
"""Licence of trained weights for which none was given."""
NO_LICENCE = "no licence given"
"""Licence of a model whose card has none: like an unknown one, it counts as the strictest."""
_BY_STRICTNESS = (*FREE, "CC BY 4.0", "CC BY-SA 4.0", "CC BY-NC 4.0", "CC BY-NC-SA 4.0")
"""Known licences, the strictest last. An unknown one counts as the strictest."""
Licences = Mapping[str, str]
"""Licence by the name of the model, or of the motion that was given."""

_recordings: list[dict[str, str]] = []


@contextmanager
def record_licences() -> Iterator[Licences]:
    """Yield the licences of all models that are loaded, and motions that are noted, within the block; they are added as
    they come, from all threads of this process."""
    recording: dict[str, str] = {}
    _recordings.append(recording)
    try:
        yield recording
    finally:
        _recordings.remove(recording)


def note_licence(name: str, licence: str) -> None:
    """Add this name and licence to the records in progress, if any; nothing without a licence."""
    for recording in _recordings if licence else ():
        recording[name] = shorten_licence(licence)


def shorten_licence(licence: str) -> str:
    """Leave out the models that a motion's licence names beside it; one that is not known stays as it is."""
    return _find_known(licence) or licence


def find_used_licences() -> Licences:
    """Return the innermost record so far; empty without one."""
    return dict(_recordings[-1]) if _recordings else {}


def find_strictest(licences: Iterable[str]) -> str:
    """Find the strictest licence; several that are not known are all named. Empty without any."""
    found = set(licences)
    unknown = sorted(each for each in found if _find_known(each) is None)
    return " and ".join(unknown) if unknown else max(found, key=_rank, default="")


def describe_licences(used: Licences) -> dict[str, Any]:
    """Describe licences as a report has them: the strictest, and that of each model; nothing where none was used."""
    return {"licence": {"strictest": find_strictest(used.values()), "models": dict(used)}} if used else {}


def format_licences(used: Licences) -> str:
    """Format licences in one line, the strictest first, each with the models that have it; empty without any."""
    by_licence: dict[str, list[str]] = {}
    for name, licence in used.items():
        by_licence.setdefault(licence, []).append(name)
    ordered = sorted(by_licence, key=_rank, reverse=True)
    return "; ".join(f"{licence} ({', '.join(by_licence[licence])})" for licence in ordered)


def shorten_names(used: Licences) -> Licences:
    """Leave out the folders of models and motions that are not bundled: what others read need not know them."""
    return {name if find_file(name) else PurePath(name).name: licence for name, licence in used.items()}


def _find_known(licence: str) -> str | None:
    """Find the known licence that a text names, before models in parentheses; of several, which a motion has that is
    joined from others, the strictest. None where one of them is not known."""
    found = [
        next((known for known in _BY_STRICTNESS if part == known or part.startswith(f"{known} (")), None)
        for part in licence.split("; ")
    ]
    known = [each for each in found if each is not None]
    return max(known, key=_BY_STRICTNESS.index) if len(known) == len(found) else None


def _rank(licence: str) -> int:
    known = _find_known(licence)
    return len(_BY_STRICTNESS) if known is None else _BY_STRICTNESS.index(known)
