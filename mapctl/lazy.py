"""Public names of a package that are imported on first use: torch and graphics libraries take seconds to import."""

from collections.abc import Callable, Iterable, Mapping
from importlib import import_module
from typing import Any


def import_lazily(
    package: str, homes: Mapping[str, str], modules: Mapping[str, str], others: Iterable[str]
) -> tuple[Callable[[str], Any], Callable[[], list[str]]]:
    """Return `__getattr__` and `__dir__` of a package, of the `homes` of its names, the `modules` with a name in it,
    and the names of `others` that it defines itself."""

    def find(name: str) -> Any:
        if name in modules:
            return import_module(modules[name])
        if name not in homes:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        return getattr(import_module(homes[name]), name)

    # What was imported for these names is not meant for users.
    return find, lambda: sorted([*homes, *modules, *others])
