"""Requests written as TOML: read, checked against a dataclass, and faults named with their file and key."""

import json
import re
import tomllib
from collections.abc import Callable, Mapping, Sequence
from functools import cache
from os import PathLike
from typing import Any, TypeVar

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


def read(path: str | PathLike[str], kind: type[T], *, what: str, unknown: Callable[[Sequence[int | str]], str]) -> T:
    """Read the file as a `kind`, as in "a scene file is ...". FileFormatError names file and key, as in
    `key[1].facing_deg: ...`, in one line; `unknown` lists the allowed keys where one is not known. What `kind`
    itself raises passes."""
    table = _parse_toml(path, what)
    try:
        return _find_adapter(kind).validate_json(table, strict=True)
    except ValidationError as error:
        raise FileFormatError(path, describe_fault(error, unknown)) from error


def describe_fault(error: ValidationError, unknown: Callable[[Sequence[int | str]], str] = lambda _: "") -> str:
    """Describe the first fault that pydantic finds in one line, as `key[1].facing_deg: ...`; `unknown` lists the keys
    that are allowed where one is not known."""
    fault = error.errors(include_url=False)[0]
    parts = [part for part in fault["loc"] if part not in _KINDS]
    where = "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in parts).lstrip(".")
    return f"{where if len(where) <= _MAX_SHOWN else shorten(where, _MAX_SHOWN)}: {_describe(fault, unknown)}"


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


def _describe(fault: Mapping[str, Any], unknown: Callable[[Sequence[int | str]], str]) -> str:
    if fault["type"] == "unexpected_keyword_argument":
        return f"there is no such key; {unknown(fault['loc'])}"
    if fault["type"] == "missing":
        return "this key is needed"
    came, message = json.dumps(fault["input"], default=str), str(fault["msg"])
    shown = came if len(came) <= _MAX_SHOWN else came[: _MAX_SHOWN - 3] + "..."
    return f"{message[0].lower()}{message[1:]}, got {shown}"
