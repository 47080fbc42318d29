"""Who hears while kernels are compiled, which happens once on a machine and takes seconds for each."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager

Listener = Callable[[int, int, bool], None]
"""Is called with a kernel's number, counted from 1 by first use, with the number of kernels in the modules that are
imported, and with True before it is compiled, False after."""

_listeners: list[Listener] = []


@contextmanager
def tell(listener: Listener) -> Iterator[None]:
    """Tell the listener of every kernel that is compiled within, in any thread; one loaded from disk is no news."""
    _listeners.append(listener)
    try:
        yield
    finally:
        _listeners.remove(listener)


def announce(number: int, total: int, *, begins: bool) -> None:
    """Tell all listeners that a kernel's compilation begins, or that it ended."""
    for listener in list(_listeners):
        listener(number, max(number, total), begins)
