"""Readers that run in processes of their own, many times in a row: forked off this one, which has imported what they
need, each takes a twentieth of a second instead of one."""

import importlib
import io
import os
import resource
import select
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from mapctl.isolated import child, process

os.environ.setdefault("PXR_WORK_THREAD_LIMIT", "1")  # before USD is imported: a forked process has none of its threads


@contextmanager
def fork_readers(seconds: float = process.SECONDS) -> Iterator[None]:
    """Have readers forked, with less time than they have; where the system cannot, they are started as always."""
    if not hasattr(os, "fork"):
        yield
        return
    before = process.execute, process.MEMORY_BYTES, process.SECONDS
    process.execute, process.MEMORY_BYTES = _fork, process.MEMORY_BYTES + _reserved_bytes()
    process.SECONDS = seconds
    try:
        yield
    finally:
        process.execute, process.MEMORY_BYTES, process.SECONDS = before


def _reserved_bytes() -> int:
    """Address space of this process, which is a forked one's too; on Linux."""
    told = Path("/proc/self/statm")
    return int(told.read_text().split()[0]) * resource.getpagesize() if told.exists() else 0


def _fork(module: str, request: bytes, seconds: float) -> subprocess.CompletedProcess[bytes]:
    answer = importlib.import_module(f"{module}.answer").answer
    out, told = os.pipe()
    pid = os.fork()
    if pid == 0:
        os.dup2(told, 1)
        os.dup2(os.open(os.devnull, os.O_WRONLY), 2)
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, signal.SIG_DFL)
        sys.stdin = io.StringIO(request.decode())
        try:
            child.serve(answer)
        finally:
            os._exit(1)
    os.close(told)
    try:
        text = _read_all(out, time.monotonic() + seconds)
    except BaseException:
        os.kill(pid, signal.SIGKILL)
        os.waitpid(pid, 0)
        raise
    status = os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])
    return subprocess.CompletedProcess([module], status, text, b"")


def _read_all(pipe: int, stop: float) -> bytes:
    pieces = []
    with os.fdopen(pipe, "rb", buffering=0) as opened:
        while True:
            if not select.select([opened], [], [], max(0.0, stop - time.monotonic()))[0]:
                raise subprocess.TimeoutExpired("reader", process.SECONDS)
            piece = opened.read(2**16)
            if not piece:
                return b"".join(pieces)
            pieces.append(piece)
