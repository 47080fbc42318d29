"""Requests written as TOML: read, checked against a dataclass, and faults named with their file and key."""

import json
import re
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import fields, is_dataclass
from difflib import get_close_matches
from functools import cache
from os import PathLike
from typing import Any, TypeVar, get_args, get_type_hints

from pydantic import ConfigDict, TypeAdapter, ValidationError

from mapctl.errors import FileFormatError
from mapctl.formats.text import one_line, read_bytes, shorten

STRICT = ConfigDict(extra="forbid", allow_inf_nan=False)
"""Configuration of dataclasses that are read: no key but their fields, and finite numbers."""
_KINDS = ("bool", "float", "str", "constrained-float", "constrained-str")
"""Kinds that pydantic names where a value may be either."""
_MAX_SHOWN = 60  # characters of a wrong value that are shown
_MAX_BYTES, _MAX_PARTS = 4 * 2**20, 64
_KEY = r"""(?:"(?:\\.|[^"\\\n])*"?|'[^'\n]*'?|[\w-]+)"""
_KEYS = re.compile(rf"(?P<deep>(?:{_KEY}[ \t]*\.[ \t]*){{{_MAX_PARTS}}})|{_KEY}")  # always matches: time is linear

T = TypeVar("T")


def read(path: str | PathLike[str], kind: type[T], *, what: str) -> T:
    """Read the file as a `kind`, a dataclass or a model of pydantic; `what` as in "a scene file is ...".
    FileFormatError names file and key, as in `key[1].facing_deg: ...`, in one line. What `kind` itself raises passes.
    """
    table = _parse_toml(path, what)
    try:
        return _find_adapter(kind).validate_json(table, strict=True)
    except ValidationError as error:
        raise FileFormatError(path, describe_fault(error, kind)) from error


def describe_fault(error: ValidationError, kind: Any) -> str:
    """Describe the first fault that pydantic finds in a `kind` in one line, as `key[1].facing_deg: ...`."""
    fault = error.errors(include_url=False)[0]
    parts = [part for part in fault["loc"] if part not in _KINDS]
    where = "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in parts).lstrip(".")
    return f"{where if len(where) <= _MAX_SHOWN else shorten(where, _MAX_SHOWN)}: {_describe(fault, kind)}"


_find_adapter = cache(TypeAdapter)


def _parse_toml(path: str | PathLike[str], what: str) -> str:
    """Return the file's table as JSON. Size and depth of keys are bounded: tomllib takes the square of both."""
    raw = read_bytes(path)
    if len(raw) > _MAX_BYTES:
        raise FileFormatError(path, f"has {len(raw) >> 10} KiB, allowed are {_MAX_BYTES >> 10} for a {what}")
    try:
        text = raw.decode("utf-8")
    except UnicodeDecodeError as error:
        raise FileFormatError(path, f"a {what} is UTF-8 text, and this is not") from error
    if any(found["deep"] for found in _KEYS.finditer(text)):
        raise FileFormatError(path, f"has a key of more than {_MAX_PARTS} parts")
    try:
        return json.dumps(tomllib.loads(text), default=str)
    except (ValueError, RecursionError) as error:  # also of whole numbers with thousands of digits
        raise FileFormatError(path, f"not TOML: {one_line(error)}") from error


def _describe(fault: Mapping[str, Any], kind: Any) -> str:
    if fault["type"] == "unexpected_keyword_argument":
        *above, key = fault["loc"]
        allowed = [item.name for item in fields(_find_table(kind, above))]
        near = "".join(f"the nearest is {name}; " for name in get_close_matches(str(key), allowed, n=1))
        return f"there is no such key; {near}allowed: {', '.join(allowed)}"
    if fault["type"] == "missing":
        return "this key is needed"
    came, message = json.dumps(fault["input"], default=str), str(fault["msg"])
    shown = came if len(came) <= _MAX_SHOWN else came[: _MAX_SHOWN - 3] + "..."
    return f"{message[0].lower()}{message[1:]}, got {shown}"


def _find_table(kind: Any, keys: Sequence[int | str]) -> Any:
    """Find the dataclass of the table that keys lead to, from that of the file."""
    for key in keys:
        kind = _find_dataclass(get_type_hints(kind).get(str(key))) or kind
    return kind


def _find_dataclass(hint: Any) -> Any:
    """Find the dataclass that a type is or holds, as `tuple[Actor, ...]`; None without one."""
    return hint if is_dataclass(hint) else next(filter(None, map(_find_dataclass, get_args(hint))), None)
