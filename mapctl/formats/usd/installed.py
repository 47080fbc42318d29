"""Whether the package usd-core is there."""

from importlib.util import find_spec


def is_installed() -> bool:
    """Return whether the package is installed."""
    return find_spec("pxr") is not None
