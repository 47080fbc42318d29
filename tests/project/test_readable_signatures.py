"""The site's extension for signatures: what it makes of classes and types, without a build of the site."""

from dataclasses import dataclass, field
from typing import NamedTuple, Protocol

import pages
import pytest

EXTENSION = pages.import_extension("readable_signatures")
format_class_signature, strip_annotated = EXTENSION.format_class_signature, EXTENSION.strip_annotated


@dataclass
class Settings:
    """Of many kinds."""

    frames: int
    sigma: float = 0.1
    names: tuple[str, ...] = ()
    table: dict = field(default_factory=dict)
    found: object = pytest
    seconds: float = field(default=1.0, kw_only=True)


class Pair(NamedTuple):
    """Of two."""

    one: int
    other: int = 2


class Speaks(Protocol):
    """Not called."""


class Spoken(Speaks):
    """Called without anything."""


class Plain:
    """With a signature of its own."""

    def __init__(self, frames: int):
        self.frames = frames


@pytest.mark.parametrize(
    ("cls", "signature"),
    [
        (Settings, "(frames, sigma=0.1, names=(), table=..., found=..., *, seconds=1.0)"),
        (Pair, "(one, other=2)"),
        (Speaks, ""),
        (Spoken, "()"),
        (Plain, None),
        (ValueError, None),
    ],
)
def test_classes_show_names_and_short_defaults(cls, signature):
    assert format_class_signature(cls) == signature


@pytest.mark.parametrize(
    ("text", "short"),
    [
        ("Annotated[float, FieldInfo(metadata=[Ge(ge=0), Le(le=3600.0)])] | None = None", "float | None = None"),
        ("tuple[Annotated[float, Gt(0)], Annotated[int, Le(1)]]", "tuple[float, int]"),
        ("Annotated[tuple[str, ...], MinLen(1)] = ()", "tuple[str, ...] = ()"),
        ("Annotated[Annotated[int, 1], 2]", "int"),
        ("float | None", "float | None"),
        ("Annotated[broken", "Annotated[broken"),
    ],
)
def test_annotated_types_are_what_they_annotate(text, short):
    assert strip_annotated(text) == short
