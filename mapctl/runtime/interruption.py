"""Ctrl-C, SIGTERM and a terminal that closes end work alike, by KeyboardInterrupt; saving defers them.

`timeout`, job schedulers and impatient fingers send a signal twice: what comes within a second is one signal.
"""

import os
import signal
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any

SIGNALS = tuple(getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name))
"""Signals that end work. Those that a process was told to ignore (nohup) are left ignored."""
REPEAT_SECONDS = 1.0
"""Time within which signals count as one, seconds."""
_RETRY_SECONDS = 0.05  # after which a signal that came while kernels are compiled comes again


def raise_on_signals() -> list[int]:
    """Raise KeyboardInterrupt from here on at every one of SIGNALS; the list gets the numbers of those that did.

    For a process' main thread.
    """
    received: list[int] = []
    until = 0.0

    def stop(number: int, frame: FrameType | None) -> None:
        nonlocal until
        if (now := time.monotonic()) < until:
            return
        if _is_in_compiler(frame):
            threading.Timer(_RETRY_SECONDS, _send_again, (number,)).start()
            return
        until = now + REPEAT_SECONDS
        received.append(number)
        raise KeyboardInterrupt

    for number in _handled_signals():
        signal.signal(number, stop)
    return received


class DeferredSignals:
    """Signals that wait until what is under way is whole."""

    def __init__(self, before: dict[int, Any]):
        """Take the handlers `before` that the signals would have gone to."""
        self.wanted: int | None = None
        """Number of the signal that waits."""
        self._handlers, self._since = before, 0.0
        self._lets_through = self._defers_all = False

    def release(self) -> None:
        """Let a signal go that waits: KeyboardInterrupt, or whatever it did before it was held."""
        number, self.wanted = self.wanted, None
        if number is None:
            return
        if not callable(self._handlers[number]):
            raise KeyboardInterrupt
        self._handlers[number](number, None)

    @contextmanager
    def let_through(self) -> Iterator[None]:
        """Let signals through at once within, as well as one that waits already."""
        self._lets_through = True
        try:
            self.release()
            yield
        finally:
            self._lets_through = False

    @contextmanager
    def defer_all(self) -> Iterator[None]:
        """Defer signals within however often they come: for saving, which is short."""
        self._defers_all = True
        try:
            yield
        finally:
            self._defers_all = False

    def receive(self, number: int, _: FrameType | None) -> None:
        """Handle a signal; a second one, more than a second after the first, is not held back."""
        now, again = time.monotonic(), self.wanted is not None
        if not again:
            self.wanted, self._since = number, now
        if not self._defers_all and (self._lets_through or (again and now > self._since + REPEAT_SECONDS)):
            self.release()


@contextmanager
def defer_signals() -> Iterator[DeferredSignals]:
    """Hold SIGNALS back within; one that still waits at the end is then let go. In other threads nothing is held."""
    if threading.current_thread() is not threading.main_thread():
        yield DeferredSignals({})
        return
    held = DeferredSignals({number: signal.getsignal(number) for number in _handled_signals()})
    for number in held._handlers:
        signal.signal(number, held.receive)
    try:
        yield held
    finally:
        for number, handler in held._handlers.items():
            signal.signal(number, handler)
    held.release()


def _send_again(number: int) -> None:
    """Send a signal to this process: to all of it, so that it wakes the main thread; on Windows that would end it."""
    if os.name == "nt":
        signal.raise_signal(number)
    else:
        os.kill(os.getpid(), number)


def _is_in_compiler(frame: FrameType | None) -> bool:
    """Return whether a frame is called by LLVM, which swallows what is raised in its callbacks and compiles on."""
    while frame is not None:
        if "llvmlite" in frame.f_code.co_filename:
            return True
        frame = frame.f_back
    return False


def _handled_signals() -> list[int]:
    """Return the signals that are neither ignored nor in the hands of something that is not Python."""
    return [number for number in SIGNALS if signal.getsignal(number) not in (signal.SIG_IGN, None)]
