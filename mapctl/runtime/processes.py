"""Processes beside this one, and Ctrl-C, which comes to all of them."""

import multiprocessing
import queue
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection
from multiprocessing.context import SpawnProcess
from types import FrameType
from typing import Any


def spawn(target: Callable[..., None], *arguments: Any) -> SpawnProcess:
    """Start a process that runs `target`, and ends when this one does. Ctrl-C is for the parent, not for it.

    A terminal sends Ctrl-C to all of its processes. One that is still importing would say so with a traceback, long
    before `target` could look away; so it is born with the signal blocked, which no import undoes.
    """
    process = multiprocessing.get_context("spawn").Process(target=target, args=arguments, daemon=True)
    with defer_ctrl_c():
        process.start()
    return process


def open_pipe(*, duplex: bool = True) -> tuple[Connection, Connection]:
    """Open a pipe and return its ends: the first reads and the second writes, or `duplex` both do both."""
    ends: Any = multiprocessing.Pipe(duplex)  # its type differs by system
    return ends


def send_queued(connection: Connection, messages: "queue.SimpleQueue[Any]") -> None:
    """Send queued messages, until None or the end of the process at the other end: for a thread, which may wait."""
    with suppress(OSError):
        while (message := messages.get()) is not None:
            connection.send(message)


@contextmanager
def reraise_ctrl_c() -> Iterator[None]:
    """Raise at the end a Ctrl-C that something within swallows.

    Some packages catch everything while they are imported, and Python itself while it collects garbage.
    """
    handler, heard = signal.getsignal(signal.SIGINT), list[int]()
    if not callable(handler) or threading.current_thread() is not threading.main_thread():
        yield
        return

    def hear(number: int, frame: FrameType | None) -> None:
        heard.append(number)
        handler(number, frame)

    signal.signal(signal.SIGINT, hear)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, handler)
    if heard:
        raise KeyboardInterrupt


@contextmanager
def defer_ctrl_c() -> Iterator[None]:
    """Defer a Ctrl-C to the end; a process that is started within never hears of one.

    The signal's mask is inherited by who is started. It does not keep Python from interrupting the main thread where
    another thread gets the signal, which would leave somebody half started, so the handler waits too.
    """
    if not hasattr(signal, "pthread_sigmask"):  # Windows
        yield
        return
    resource_tracker.ensure_running()  # starting this helper of multiprocessing's would end the blocking
    heard, handler, is_main = [], signal.getsignal(signal.SIGINT), threading.current_thread() is threading.main_thread()
    if is_main:
        signal.signal(signal.SIGINT, lambda *_: heard.append(True))
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
        if is_main:
            signal.signal(signal.SIGINT, handler)
        if heard:
            signal.raise_signal(signal.SIGINT)
