"""Requests written as TOML: read, checked against a dataclass, and faults named with their file and key."""

import json
import tomllib
from collections.abc import Callable, Mapping, Sequence
from os import PathLike
from pathlib import Path
from typing import Any, TypeVar

from pydantic import ConfigDict, TypeAdapter, ValidationError

from mapctl.errors import FileFormatError

STRICT = ConfigDict(extra="forbid", allow_inf_nan=False)
"""Configuration of dataclasses that are read: no key but their fields, and finite numbers."""
_KINDS = ("bool", "float", "str", "constrained-float", "constrained-str")
"""Kinds that pydantic names where a value may be either."""
_MAX_SHOWN = 60  # characters of a wrong value that are shown

T = TypeVar("T")


def read(path: str | PathLike[str], kind: type[T], *, what: str, unknown: Callable[[Sequence[int | str]], str]) -> T:
    """Read the file as a `kind`, as in "a scene file is ...". FileFormatError names file and key, as in
    `key[1].facing_deg: ...`, in one line; `unknown` says which keys are allowed where one is not known. What `kind`
    itself raises passes."""
    table = json.dumps(_parse_toml(path, what), default=str)
    try:
        return TypeAdapter(kind).validate_json(table, strict=True)
    except ValidationError as error:
        fault = error.errors(include_url=False)[0]
        place = [part for part in fault["loc"] if part not in _KINDS]
        where = "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in place).lstrip(".")
        raise FileFormatError(path, f"{where}: {_describe_fault(fault, unknown)}") from error


def _parse_toml(path: str | PathLike[str], what: str) -> Mapping[str, Any]:
    try:
        return tomllib.loads(Path(path).read_bytes().decode("utf-8"))
    except OSError as error:
        raise FileFormatError(path, error.strerror or str(error)) from error
    except UnicodeDecodeError as error:
        raise FileFormatError(path, f"a {what} is UTF-8 text, and this is not") from error
    except tomllib.TOMLDecodeError as error:
        raise FileFormatError(path, f"not TOML: {error}") from error


def _describe_fault(fault: Mapping[str, Any], unknown: Callable[[Sequence[int | str]], str]) -> str:
    if fault["type"] == "unexpected_keyword_argument":
        return f"there is no such key; {unknown(fault['loc'])}"
    if fault["type"] == "missing":
        return "this key is needed"
    came, message = json.dumps(fault["input"], default=str), str(fault["msg"])
    shown = came if len(came) <= _MAX_SHOWN else came[: _MAX_SHOWN - 3] + "..."
    return f"{message[0].lower()}{message[1:]}, got {shown}"
