"""Processes beside this one."""

import multiprocessing
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from multiprocessing import resource_tracker
from multiprocessing.context import SpawnProcess
from typing import Any


def spawn(target: Callable[..., None], *arguments: Any) -> SpawnProcess:
    """A new process that runs `target`, and ends when this one does. Ctrl-C is for the one who started it, not for it.

    A terminal sends Ctrl-C to all of its processes. One that is still importing would say so with a traceback, long
    before `target` could look away; so it is born with the signal blocked, which no import undoes.
    """
    process = multiprocessing.get_context("spawn").Process(target=target, args=arguments, daemon=True)
    with _ctrl_c_waits():
        process.start()
    return process


@contextmanager
def _ctrl_c_waits() -> Iterator[None]:
    """A Ctrl-C that comes now arrives at the end; whoever is started now never hears of one."""
    if not hasattr(signal, "pthread_sigmask"):  # Windows
        yield
        return
    resource_tracker.ensure_running()  # starting this helper of multiprocessing's would end the blocking
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
