"""Licences of models: which is the strictest, what a job was made with, and whether a model may be in the free set."""

import json
import re
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import PurePath
from typing import Any

from mapctl.errors import CheckpointError
from priors import weight_sets

FREE = ("free for any use", "CC0 1.0")
"""Licences of models of the free set: nothing is asked of who uses them."""
OF_DATA = "that of the training data"
"""Licence of trained weights for which none was told."""
NONE_TOLD = "no licence told"
"""Of a model whose card leaves it out: like one that is not known, it is taken for stricter than all."""
_BY_STRICTNESS = (*FREE, "CC BY 4.0", "CC BY-SA 4.0", "CC BY-NC 4.0", "CC BY-NC-SA 4.0")
"""Known licences, the strictest last. One that is not known is taken for stricter than all, since nobody can tell."""
_ORIGINS = ("began_with", "init", "density", "refiner", "solved_by")
"""Keys of a card under which other models are named: those that it began with, learnt from, or whose motion it saw."""
_ORIGIN_OPTIONS = re.compile(r"--(?:init|density|refiner)[ =]('[^']*'|\S+)")
_NOT_FREE = re.compile(r"bandai|\bdataset-[12]_|\bBY-NC|non-?commercial", re.IGNORECASE)
"""What cards of models say that were trained on data which is not free."""

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
    """Note that something of this name and licence is used, where somebody records that; nothing without a licence."""
    for recording in _recordings if licence else ():
        recording[name] = shorten_licence(licence)


def shorten_licence(licence: str) -> str:
    """Leave out the models that a motion's licence names beside it; one that is not known stays as it is."""
    return _find_known(licence) or licence


def find_used_licences() -> Licences:
    """Find what the innermost record holds so far; nothing where nobody records."""
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
    return {name if weight_sets.find_file(name) else PurePath(name).name: licence for name, licence in used.items()}


def check_free(name: str, licence: str, told: Mapping[str, Mapping[str, Any]]) -> None:
    """Raise CheckpointError where a model of the free set is not free: by its own licence, or by what its card has told
    under `data` and `training`: data that is not free, or a model that it began with, was trained beside, or whose
    motion it was trained on."""
    fault = _find_fault(licence, told)
    if fault is not None:
        raise CheckpointError(f"{name} is not free, though it lies with the free weights: {fault}")


def find_unfree(words: str) -> str | None:
    """Find what says that something is not free in a text such as the path of a clip; None where nothing does."""
    found = _NOT_FREE.search(words)
    return None if found is None else found.group()


def _find_fault(licence: str, told: Mapping[str, Mapping[str, Any]]) -> str | None:
    if licence not in FREE:
        return f"its licence is {licence!r}, allowed: {', '.join(FREE)}"
    for words in _list_texts(told):
        if (found := find_unfree(words)) is not None:
            return f"its card names {found!r} in {words[:60]!r}"
    for line in told.get("data", {}).get("made", ()):  # splices: how many, and the stitcher's licence
        if not any(line.endswith(f"({free})") for free in FREE):
            return f"it was trained on clips of a model that is not free: {line}"
    began = told.get("data", {}).get("init")
    if isinstance(began, Mapping) and began.get("licence", FREE[0]) not in FREE:
        return f"it began with {began.get('name')!r}, whose licence is {began['licence']!r}"
    for key, origin in _list_origins(told):
        if (fault := _find_origin_fault(origin)) is not None:
            return f"{key} is {origin!r}, {fault}"
    return _find_density_fault(told.get("data", {}))


def _find_density_fault(data: Mapping[str, Any]) -> str | None:
    """Find whether a refiner's density is another than the free one of its name: every set has one."""
    density, config = data.get("density"), data.get("density_config")
    if density is None or config is None:
        return None
    path = weight_sets.find_file(f"free/{weight_sets.split_name(density)[1]}")
    own = None if path is None else json.loads(path.with_suffix(".json").read_text(encoding="utf-8"))["config"]
    return None if own == config else f"its density, {density!r}, has other settings than that of the free weights"


def _find_origin_fault(origin: str) -> str | None:
    """Find why a free model may not come from another; a name without a set is one of the free set here."""
    weights, model = weight_sets.split_name(origin)
    if model != origin and weights != "free":
        return f"a model of the {weights} weights"
    if weight_sets.find_file(f"free/{model}") is None:
        return "which is no model of the free weights"
    return None


def _list_texts(values: Any) -> Iterator[str]:
    """List all texts of a tree, keys too."""
    match values:
        case str():
            yield values
        case Mapping():
            for key, value in values.items():
                yield str(key)
                yield from _list_texts(value)
        case list() | tuple():
            for value in values:
                yield from _list_texts(value)
        case _:
            return


def _list_origins(values: Any) -> Iterator[tuple[str, str]]:
    """List the models that a tree names under the keys for that, and as options of the command of its training."""
    if isinstance(values, list | tuple):
        for value in values:
            yield from _list_origins(value)
    if not isinstance(values, Mapping):
        return
    for key, value in values.items():
        if key in _ORIGINS:
            yield from ((key, each) for each in _list_texts_of_origin(value))
        elif key in ("command", "remark") and isinstance(value, str):
            yield from (("its command", found.strip("'")) for found in _ORIGIN_OPTIONS.findall(value))
        else:
            yield from _list_origins(value)


def _list_texts_of_origin(value: Any) -> Iterator[str]:
    """List the names of models under a key: the text, the `name` of a table, or those of a list."""
    if isinstance(value, Mapping):
        value = value.get("name")
    yield from (each for each in _list_texts(value) if each)


def _find_known(licence: str) -> str | None:
    """Find the known licence that a text names, before models in parentheses; of several, which a motion has that is
    joined from others, the strictest. None where one of them is not known."""
    found = [_find_known_part(part) for part in licence.split("; ")]
    known = [each for each in found if each is not None]
    return max(known, key=_BY_STRICTNESS.index) if len(known) == len(found) else None


def _find_known_part(part: str) -> str | None:
    return next((known for known in _BY_STRICTNESS if part == known or part.startswith(f"{known} (")), None)


def _rank(licence: str) -> int:
    known = _find_known(licence)
    return len(_BY_STRICTNESS) if known is None else _BY_STRICTNESS.index(known)
