"""The side of such a process: its bounds, what it is asked, and how it answers."""

import gc
import json
import os
import sys
import warnings
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

try:
    import resource
except ImportError:  # Windows
    resource = None

Array = np.ndarray
Found = tuple[dict[str, Any], dict[str, Array]]
"""What is said of a file, and tables by name."""


class Refusal(Exception):
    """A file that is not read, or of which what was chosen is not there; `args[0]` says why, in one line."""


def serve(answer: Callable[[Mapping[str, Any], Mapping[str, Array]], Found]) -> None:
    """Read the request from standard input, answer it on standard output and in a file, and end the process.

    The process ends without the libraries' own last steps: what is broken in a file may break them.
    """
    request = json.loads(sys.stdin.read())
    _bound_memory(request["memory_bytes"])
    gc.disable()
    warnings.simplefilter("ignore")  # numbers that are not finite are looked for once they are read
    folder = Path(request["folder"])
    try:
        said, tables = answer(request, _read_arrays(folder / "request.npz"))
        if tables:
            np.savez(folder / "answer.npz", allow_pickle=False, **tables)
    except Refusal as refusal:
        said = {"refused": str(refusal.args[0])}
    except MemoryError:
        said = {"refused": f"needs more than {request['memory_bytes'] >> 30} GiB of memory"}
    except Exception as error:
        said = {"fault": f"{type(error).__name__}: {error}"}
    os.write(1, b"\n" + json.dumps(said).encode() + b"\n")
    os._exit(0)


def _bound_memory(count: int) -> None:
    """Bound the address space, where the system can (Linux; macOS may refuse, Windows cannot), and leave no file where
    it crashes. Without the bound, time alone ends a reader that a file leads astray."""
    if resource is None:
        return
    for what, limit in ((resource.RLIMIT_AS, count), (resource.RLIMIT_CORE, 0)):
        with suppress(ValueError, OSError):
            resource.setrlimit(what, (limit, limit))


def _read_arrays(path: Path) -> dict[str, Array]:
    if not path.is_file():
        return {}
    with np.load(path, allow_pickle=False) as held:
        return dict(held)


def check_extent(frames: int, joints: int, most: int) -> None:
    """Raise Refusal where the rotations of so many frames and joints would fill the memory."""
    if frames * joints > most:
        raise Refusal(f"{frames} frames of {joints} joints, allowed are {most} in all")
