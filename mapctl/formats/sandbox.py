"""Readers of files by native code, each call in a process of its own: such code may crash, take long, or fill memory.

The process imports what the reader needs and no torch, so that it starts in a fraction of a second.
"""

import gc
import os
import pickle
import signal
import subprocess
import sys
import warnings
from collections.abc import Callable
from contextlib import suppress
from os import PathLike
from pathlib import Path
from typing import Any

from mapctl.errors import FileFormatError
from mapctl.formats.text import one_line

try:
    import resource
except ImportError:  # Windows
    resource = None

MEMORY_BYTES = 4 * 2**30
"""Most address space of such a process."""
SECONDS, SECONDS_PER_MEBIBYTE = 120.0, 2.0
"""Most time that it may take: for any file, and besides by its size."""
_LONGEST_MESSAGE = 300
_ROOT = str(Path(__file__).resolve().parents[2])


class Refusal(Exception):
    """A file that is not read, or of which what was chosen is not there; `args[0]` is the reason, in one line."""


def call(reader: Callable[..., Any], path: str | PathLike[str], **options: Any) -> Any:
    """Return `reader(path, **options)`, called in a process of its own.

    FileFormatError where it raises Refusal, crashes, takes too long or needs too much memory.
    """
    seconds = SECONDS + SECONDS_PER_MEBIBYTE * Path(path).stat().st_size / 2**20
    request = pickle.dumps(MEMORY_BYTES) + pickle.dumps((reader, str(Path(path).absolute()), options))
    words = [sys.executable, "-P", "-c", "from mapctl.formats import sandbox; sandbox.serve()"]
    # mapctl is found there, and nothing starts threads
    paths = [_ROOT, *filter(None, [os.environ.get("PYTHONPATH")])]
    single = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "PXR_WORK_THREAD_LIMIT"), "1")
    environment = {**os.environ, **single, "PYTHONPATH": os.pathsep.join(paths), "PYTHONIOENCODING": "utf-8"}
    try:
        done = subprocess.run(words, input=request, capture_output=True, timeout=seconds, env=environment)
    except subprocess.TimeoutExpired:
        raise FileFormatError(path, f"cannot be read within {seconds:.0f} seconds") from None
    if done.returncode == 0:
        outcome, content = pickle.loads(done.stdout)  # noqa: S301 - of our own reader
        if outcome == "refused":
            raise FileFormatError(path, one_line(content, _LONGEST_MESSAGE))
        return content
    errors = done.stderr.decode(errors="replace")
    if any(sign in errors for sign in ("MemoryError", "bad_alloc", "failed to map segment")):
        raise FileFormatError(path, f"needs more than {MEMORY_BYTES >> 30} GiB of memory")
    if done.returncode == 1:
        raise RuntimeError(f"{path}: {(errors.strip().splitlines() or ['its reader cannot run'])[-1]}")
    with suppress(ValueError):
        raise FileFormatError(path, f"is broken: its reader ends by {signal.Signals(-done.returncode).name}")
    raise FileFormatError(path, f"is broken: its reader ends with status {done.returncode}")


def serve() -> None:
    """Run one request from standard input, answer on standard output, and end the process without the libraries' own
    last steps: what is broken in a file may break them."""
    answer = os.dup(1)
    os.dup2(2, 1)  # what libraries print is no answer
    memory = pickle.load(sys.stdin.buffer)  # noqa: S301 - of our own process
    if resource is not None:  # Windows has no such bounds, macOS may refuse them: time alone ends the reader there
        for what, limit in ((resource.RLIMIT_AS, memory), (resource.RLIMIT_CORE, 0)):
            with suppress(ValueError, OSError):
                resource.setrlimit(what, (limit, limit))
    reader, path, options = pickle.load(sys.stdin.buffer)  # noqa: S301
    gc.disable()
    warnings.simplefilter("ignore")  # numbers that are not finite are looked for once they are read
    try:
        outcome = "read", reader(path, **options)
    except Refusal as refusal:
        outcome = "refused", str(refusal.args[0])
    except MemoryError:
        outcome = "refused", f"needs more than {memory >> 30} GiB of memory"
    with os.fdopen(answer, "wb") as opened:
        pickle.dump(outcome, opened, protocol=5)
    os._exit(0)
