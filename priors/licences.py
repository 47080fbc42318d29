"""Licences of models: which is the strictest, and what a job was made with."""

from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import PurePath
from typing import Any

from priors import weight_sets

FREE = ("free for any use", "CC0 1.0")
"""Licences of models of the free set: nothing is asked of who uses them."""
OF_DATA = "that of the training data"
"""Licence of trained weights for which none was told."""
NONE_TOLD = "no licence told"
"""Of a model whose card leaves it out: like one that is not known, it is taken for stricter than all."""
_BY_STRICTNESS = (*FREE, "CC BY 4.0", "CC BY-SA 4.0", "CC BY-NC 4.0", "CC BY-NC-SA 4.0")
"""Known licences, the strictest last. One that is not known is taken for stricter than all, since nobody can tell."""
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
