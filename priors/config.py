"""What shapes of networks and recipes share: conversion to a card's JSON and back, and a check of counts."""

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any, ClassVar, TypeVar

from pydantic import TypeAdapter, ValidationError

from mapctl.errors import RequestError
from mapctl.formats import toml

C = TypeVar("C", bound="NetworkConfig")
_MAX_COUNT, _MAX_ENTRIES = 4096, 64  # of a shape that a card describes


@dataclass(frozen=True)
class NetworkConfig:
    """Shape of a network. Its subclasses are frozen dataclasses whose fields all have defaults."""

    __pydantic_config__ = toml.STRICT
    FIXED: ClassVar[Mapping[str, Any]] = {}
    """Entries of cards that are no choice: the only value that each may have."""

    def as_card(self) -> dict[str, Any]:
        """Convert to a card's JSON, which knows no tuples."""
        return {name: list(value) if isinstance(value, tuple) else value for name, value in asdict(self).items()}

    @classmethod
    def of_card(cls: type[C], config: Mapping[str, Any]) -> C:
        """Invert `as_card`; RequestError for fields that are not these, of another type or absurdly large."""
        free = {name: value for name, value in config.items() if cls.FIXED.get(name, ...) != value}
        try:
            found = TypeAdapter(cls).validate_json(json.dumps(free), strict=True)
        except ValidationError as error:
            raise RequestError(toml.describe_fault(error)) from error
        for name, value in vars(found).items():
            entries = value if isinstance(value, tuple) else (value,)
            if len(entries) > _MAX_ENTRIES or any(isinstance(each, int) and each > _MAX_COUNT for each in entries):
                raise RequestError(f"{name} is beyond {_MAX_ENTRIES} entries of up to {_MAX_COUNT}")
        return found


def require_at_least(settings: Any, least: int, *names: str) -> None:
    """Raise RequestError unless each of these fields is at least so much."""
    for name in names:
        if getattr(settings, name) < least:
            raise RequestError(f"{name} must be at least {least}, got {getattr(settings, name)}")
