"""What shapes of networks and recipes share: conversion to a card's JSON and back, and a check of counts."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from typing import Any, TypeVar

from mapctl.errors import RequestError

C = TypeVar("C", bound="NetworkConfig")


@dataclass(frozen=True)
class NetworkConfig:
    """Shape of a network. Its subclasses are frozen dataclasses whose fields all have defaults."""

    def as_card(self) -> dict[str, Any]:
        """Convert to a card's JSON, which knows no tuples."""
        return {name: list(value) if isinstance(value, tuple) else value for name, value in asdict(self).items()}

    @classmethod
    def of_card(cls: type[C], config: Mapping[str, Any]) -> C:
        """Invert `as_card`; KeyError or TypeError for fields that are not these."""
        tuples = [field.name for field in fields(cls) if isinstance(field.default, tuple)]
        return cls(**{**config, **{name: tuple(config[name]) for name in tuples}})


def require_at_least(settings: Any, least: int, *names: str) -> None:
    """Raise RequestError unless each of these fields is at least so much."""
    for name in names:
        if getattr(settings, name) < least:
            raise RequestError(f"{name} must be at least {least}, got {getattr(settings, name)}")
