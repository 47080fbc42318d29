"""Running a module of this package in a process of its own, with bounds on its time and memory."""

import json
import os
import signal
import subprocess
import sys
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np

from mapctl.errors import FileFormatError

MEMORY_BYTES = 4 * 2**30
"""Most address space of such a process."""
SECONDS, SECONDS_PER_MEBIBYTE = 120.0, 2.0
"""Most time that it may take: for any file, and besides by its size."""
_LONGEST_MESSAGE = 300
_PACKAGE_FOLDER = str(Path(__file__).resolve().parents[2])


@dataclass(frozen=True, eq=False)
class Answer:
    """What the process found."""

    said: dict[str, Any]
    """Text and small numbers, as JSON has them."""
    arrays: dict[str, np.ndarray]
    """Tables, by name."""


def ask(
    module: str, path: str | PathLike[str], request: Mapping[str, Any], arrays: Mapping[str, np.ndarray] | None = None
) -> Answer:
    """Run `mapctl.isolated.MODULE` on the file `path`; `request` and `arrays` are what it gets besides.

    FileFormatError where it refuses the file, crashes on it, takes too long or needs too much memory.
    """
    with tempfile.TemporaryDirectory(prefix="mapctl-") as folder:
        given = Path(folder) / "request.npz"
        if arrays:
            np.savez(given, allow_pickle=False, **arrays)
        words = {"path": str(Path(path).absolute()), "folder": folder, "memory_bytes": MEMORY_BYTES, **request}
        seconds = SECONDS + SECONDS_PER_MEBIBYTE * Path(path).stat().st_size / 2**20
        text = _run(f"mapctl.isolated.{module}", path, json.dumps(words), seconds)
        said = _parse(text)
        if "refused" in said:
            raise FileFormatError(path, _one_line(said["refused"]))
        if "fault" in said:
            raise RuntimeError(f"{path}: {said['fault']}")
        found = Path(folder) / "answer.npz"
        if not found.is_file():
            return Answer(said, {})
        with np.load(found, allow_pickle=False) as held:
            return Answer(said, dict(held))


def _run(module: str, path: str | PathLike[str], request: str, seconds: float) -> str:
    """Return what the process writes; what libraries say on its standard error is for nobody."""
    try:
        done = execute(module, request.encode(), seconds)
    except subprocess.TimeoutExpired:
        raise FileFormatError(path, f"cannot be read within {seconds:.0f} seconds") from None
    if done.returncode == 0:
        return done.stdout.decode()
    if b"MemoryError" in done.stderr or b"bad_alloc" in done.stderr:
        raise FileFormatError(path, f"needs more than {MEMORY_BYTES >> 30} GiB of memory")
    if done.returncode < 0 or done.returncode > 2:
        raise FileFormatError(path, f"cannot be read: it is broken in a way that ends its reader ({_name(done)})")
    last = done.stderr.decode(errors="replace").strip().splitlines()[-1:] or ["no reason given"]
    raise RuntimeError(f"{module} cannot run: {last[0]}")


def execute(module: str, request: bytes, seconds: float) -> subprocess.CompletedProcess[bytes]:
    """Run a module with a request on its standard input; TimeoutExpired where it takes too long."""
    words = [sys.executable, "-P", "-m", module]
    return subprocess.run(words, input=request, capture_output=True, timeout=seconds, env=_environment(), check=False)


def _name(done: subprocess.CompletedProcess[bytes]) -> str:
    try:
        return signal.Signals(-done.returncode).name
    except ValueError:
        return f"status {done.returncode}"


def _environment() -> dict[str, str]:
    """Return this process's environment, in which the package is found and nothing starts threads."""
    paths = [_PACKAGE_FOLDER, *filter(None, [os.environ.get("PYTHONPATH")])]
    single = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "PXR_WORK_THREAD_LIMIT"), "1")
    return {**os.environ, **single, "PYTHONPATH": os.pathsep.join(paths), "PYTHONIOENCODING": "utf-8"}


def _parse(text: str) -> dict[str, Any]:
    """Return the answer: the last line, whatever a library may have written before it."""
    return json.loads(text.strip().splitlines()[-1])


def _one_line(message: str) -> str:
    plain = "".join(letter if letter.isprintable() else " " for letter in " ".join(message.split()))
    return plain if len(plain) <= _LONGEST_MESSAGE else f"{plain[: _LONGEST_MESSAGE - 3]}..."
