"""Children of a process that has prepared: what it has imported, loaded and compiled, they share.

Memory is shared until one of them writes to it. A process with several threads cannot be forked: only the one that
forks would go on, and what the others had locked would stay so. Hence a process of its own prepares and forks, whose
maker may have as many threads as it likes; it is no copy of its maker, and does not run the maker's script again.
"""

import copyreg
import gc
import io
import os
import signal
import subprocess
import sys
import threading
import time
import traceback
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from multiprocessing import connection, reduction, spawn
from pathlib import Path
from typing import Any

from mapctl.runtime.processes import defer_ctrl_c, open_pipe

AVAILABLE = sys.platform == "linux"
"""Whether processes are forked here. On macOS the system's own libraries do not survive it; Windows has no fork."""
_ONE_THREAD = {
    name: "1" for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")
}
_NO_GPU = {"CUDA_VISIBLE_DEVICES": ""}  # its driver has threads
_END_SECONDS = 0.2
_PID_BYTES = 8

Prepare = Callable[[], Any]
"""Prepares what all children share; it must leave no thread behind."""
Target = Callable[..., None]
"""What a child runs: with its connection, what was prepared, and its arguments."""


class _Pickler(reduction.ForkingPickler):
    """Pickler that copies tensors, where that of multiprocessing would share them, and so bind the processes."""

    def __init__(self, file: io.BytesIO):
        super().__init__(file)
        self.dispatch_table = copyreg.dispatch_table


class ForkedProcess:
    """A child, of which the system tells by a pipe when it ends."""

    def __init__(self, sentinel: connection.Connection):
        """`sentinel` gets the child's process id, 0 where it cannot be forked, and ends with the child."""
        self._sentinel, self._pid = sentinel, None

    @property
    def pid(self) -> int | None:
        """The child's process id; None where it is not forked yet."""
        if self._pid is None and self._sentinel.poll(0):
            with suppress(EOFError):
                self._pid = int.from_bytes(self._sentinel.recv_bytes(_PID_BYTES), "big")
        return self._pid or None

    @property
    def refused(self) -> bool:
        """Whether the process cannot fork, since what was prepared has threads."""
        return self.pid is None and self._pid == 0

    def is_alive(self) -> bool:
        """Whether it runs, or will."""
        if self.pid is None and not self._sentinel.poll(0):
            return self._pid is None
        return not self._sentinel.poll(0)  # nothing more is ever sent, so that what comes is the end

    def join(self, timeout: float | None = None) -> None:
        """Wait until it has ended."""
        end = None if timeout is None else time.monotonic() + timeout
        while self.is_alive() and (end is None or time.monotonic() < end):
            connection.wait([self._sentinel], None if end is None else max(0.0, end - time.monotonic()))

    def kill(self) -> None:
        """End it at once, if it has begun."""
        if self.is_alive() and self.pid is not None:
            os.kill(self.pid, signal.SIGKILL)


class ForkingProcess:
    """A process that prepares and then forks a child whenever it is asked; it ends with the one who made it."""

    def __init__(self, prepare: Prepare, target: Target):
        """Start it; both are sent there, so that they must be importable by name."""
        self._connection, theirs = open_pipe()
        handle = theirs.fileno()
        path = spawn.get_preparation_data("forking")["sys_path"]
        code = f"import sys; sys.path[:] = {path!r}; from mapctl.runtime import forking; forking.serve({handle})"
        with defer_ctrl_c():
            self._process = subprocess.Popen(
                [os.fsdecode(spawn.get_executable()), "-c", code],
                pass_fds=[handle],
                stdin=subprocess.DEVNULL,
                env={**os.environ, **_ONE_THREAD, **_NO_GPU},
            )
        theirs.close()
        self._lock = threading.Lock()
        self._connection.send_bytes(_dump((prepare, target)))

    @property
    def pid(self) -> int:
        """Its process id."""
        return self._process.pid

    @property
    def ended(self) -> bool:
        """Whether it has ended, so that nothing can be started any more."""
        return self._process.poll() is not None

    def start(self, *arguments: Any) -> tuple[connection.Connection, ForkedProcess]:
        """Have a child forked as soon as all is prepared; returns at once, with the connection to it.

        OSError where the process has ended.
        """
        message = _dump(arguments)
        ours, theirs = open_pipe()
        reader, writer = open_pipe(duplex=False)
        with self._lock, theirs, writer:
            self._connection.send_bytes(message)
            for end in (theirs, writer):
                reduction.send_handle(self._connection, end.fileno(), self.pid)
        return ours, ForkedProcess(reader)

    def close(self) -> None:
        """End it, but not its children; harmless the second time."""
        self._connection.close()
        try:
            self._process.wait(_END_SECONDS)
        except subprocess.TimeoutExpired:  # it still prepares, and so does not listen
            self._process.kill()
            self._process.wait()


@dataclass
class SharedBases:
    """Forking processes by what they prepare, each as long as somebody uses it."""

    _bases: dict[bytes, ForkingProcess] = field(default_factory=dict)
    _users: dict[bytes, int] = field(default_factory=dict)
    _lock: threading.Lock = field(default_factory=threading.Lock)

    def use(self, prepare: Prepare, target: Target) -> "tuple[bytes, ForkingProcess]":
        """Return the process that prepares this, made if there is none, and the key by which to release it."""
        key = _dump((prepare, target))
        with self._lock:
            if key in self._bases and self._bases[key].ended:
                self._bases.pop(key).close()
            if key not in self._bases:
                self._bases[key] = ForkingProcess(prepare, target)
            self._users[key] = self._users.get(key, 0) + 1
            return key, self._bases[key]

    def pid(self, key: bytes) -> int:
        """Return the process id of the one that was got under a key."""
        return self._bases[key].pid

    def release(self, key: bytes) -> None:
        """Use it no more; without users it ends."""
        with self._lock:
            self._users[key] -= 1
            if not self._users[key]:
                del self._users[key]
                self._bases.pop(key).close()


def can_fork_for(*sent: Any) -> bool:
    """Return whether a process can be forked for this: what a script defines itself is known to the script alone, and
    to processes that run it again (`mapctl.runtime.processes.spawn`)."""
    return AVAILABLE and b"__main__" not in _dump(sent)


def serve(handle: int) -> None:
    """Prepare, and fork until the maker is gone: the main program of a forking process."""
    maker = connection.Connection(handle)
    with suppress(EOFError, KeyboardInterrupt):
        prepare, target = _load(maker.recv_bytes())
        prepared = prepare()
        gc.collect()
        gc.freeze()  # a collection writes to every object that it looks at, which would then be shared no more
        while True:
            arguments = _load(maker.recv_bytes())
            ends = [connection.Connection(reduction.recv_handle(maker)) for _ in range(2)]
            _fork(maker, target, prepared, arguments, ends)
            _reap()


def _fork(
    maker: connection.Connection, target: Target, prepared: Any, arguments: Any, ends: list[connection.Connection]
) -> None:
    ours, sentinel = ends
    if _count_threads() > 1:
        _send_pid(sentinel, 0)
    elif not os.fork():
        maker.close()
        _send_pid(sentinel, os.getpid())  # before all else, so that whoever hears of it can end it
        _run_child(target, ours, prepared, arguments)
    for end in ends:
        end.close()


def _send_pid(sentinel: connection.Connection, pid: int) -> None:
    sentinel.send_bytes(pid.to_bytes(_PID_BYTES, "big"))


def _run_child(target: Target, ours: connection.Connection, prepared: Any, arguments: Any) -> None:
    status = 1
    try:
        target(ours, prepared, *arguments)
        status = 0
    except BaseException:
        traceback.print_exc()
    finally:
        with suppress(Exception):
            sys.stdout.flush()
            sys.stderr.flush()
        os._exit(status)  # nothing of the process that it is a copy of is its own to clean up


def _reap() -> None:
    """Let children that have ended go."""
    with suppress(ChildProcessError):
        while os.waitpid(-1, os.WNOHANG)[0]:
            pass


def _dump(content: Any) -> bytes:
    file = io.BytesIO()
    _Pickler(file).dump(content)
    return file.getvalue()


def _load(content: bytes) -> Any:
    return reduction.ForkingPickler.loads(content)  # pyright: ignore[reportAttributeAccessIssue]


def _count_threads() -> int:
    return sum(1 for _ in Path("/proc/self/task").iterdir())
