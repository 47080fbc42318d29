"""Progress of long work, as a function that is told of it."""

from collections.abc import Callable

Progress = Callable[[int, int], None]
"""Function called with work done and work in all."""
