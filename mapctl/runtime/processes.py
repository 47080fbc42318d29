"""Processes that work beside this one: they end with it, and Ctrl-C reaches this one alone."""

import multiprocessing
import queue
import signal
import sys
from collections.abc import Callable
from contextlib import suppress
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from typing import Any

_CONTEXT: Any = multiprocessing.get_context("forkserver" if sys.platform == "linux" else "spawn")


def preload(*modules: str) -> None:
    """Have these modules imported once for all processes that are started here, where the system can fork them."""
    if sys.platform == "linux":
        _CONTEXT.set_forkserver_preload([*modules])


def spawn(target: Callable[..., None], *arguments: Any) -> BaseProcess:
    """Start a process that runs `target`, and ends when this one does. Both are sent there, so that they must be
    importable by name, and a script needs its `if __name__ == "__main__"`."""
    process: BaseProcess = _CONTEXT.Process(target=_run, args=(target, *arguments), daemon=True)
    process.start()
    return process


def send_queued(connection: Connection, messages: "queue.SimpleQueue[Any]") -> None:
    """Send queued messages, until None or the end of the process at the other end: for a thread, which may wait."""
    with suppress(OSError):
        while (message := messages.get()) is not None:
            connection.send(message)


def _run(target: Callable[..., None], *arguments: Any) -> None:
    """Run the target in the new process. A terminal sends Ctrl-C to all of its processes."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    target(*arguments)
