"""The jobs: each turns a request into terms, solves, and returns a Solution."""

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from controllers.follow import FollowSettings as FollowSettings
    from controllers.follow import follow as follow
    from controllers.generate import GenerateSettings as GenerateSettings
    from controllers.generate import generate as generate

_HOMES = {"follow": "controllers.follow", "FollowSettings": "controllers.follow",
          "generate": "controllers.generate", "GenerateSettings": "controllers.generate"}  # fmt: skip


def __getattr__(name: str):
    if name not in _HOMES:
        raise AttributeError(f"module 'controllers' has no attribute {name!r}")
    return getattr(import_module(_HOMES[name]), name)
