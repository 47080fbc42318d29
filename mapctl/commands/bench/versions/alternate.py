"""Two versions of mapctl take turns on this machine, so that other work on it slows both alike."""

import math
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path

from controllers.benchmarks.shared.tables import Row
from mapctl.commands.bench.versions import timed_jobs
from mapctl.errors import RequestError
from mapctl.runtime.memory import measure_children_seconds

_JOBS = ("steer, ms a frame", "follow circle:4, ms a frame")
_START_UP = ("follow", "line:3", "--seconds", "1", "-o")


def time_versions(ours: Path, other: Path, *, turns: int) -> list[Row]:
    """Time steering, following and the start-up of `mapctl follow` in two checkouts, so many times in turn.

    Rows give processor time, the least of all turns, and the median ratio of neighbouring turns. RequestError where a
    folder holds no mapctl, or one that cannot be timed.
    """
    for folder in (ours, other):
        if not (folder / "mapctl" / "__main__.py").exists():
            raise RequestError(f"{folder} is no checkout of mapctl")
    with ExitStack() as stack:
        programs = [stack.enter_context(_run_jobs(folder)) for folder in (ours, other)]
        times = [[_ask(program) for program in programs] for _ in range(turns)]
    rows = [_summarise(job, [[mine[k], theirs[k]] for mine, theirs in times]) for k, job in enumerate(_JOBS)]
    starts = [[_time_start_up(folder) for folder in (ours, other)] for _ in range(turns + 1)]
    return [*rows, _summarise("start-up of follow, ms", starts[1:])]  # the first turn fills caches


def _summarise(what: str, turns: Sequence[Sequence[float]]) -> Row:
    mine, theirs = zip(*turns, strict=True)
    ratio = statistics.median(b / a for a, b in turns)
    return {"what": what, "this": min(mine), "other": min(theirs), "times_faster": ratio}


def _environment(folder: Path) -> dict[str, str]:
    return {**os.environ, "PYTHONPATH": str(folder.resolve()), "OMP_NUM_THREADS": "1"}


@contextmanager
def _run_jobs(folder: Path) -> Iterator["subprocess.Popen[str]"]:
    """Run `timed_jobs` on a checkout until the block ends."""
    program = subprocess.Popen(
        [sys.executable, "-P", str(Path(timed_jobs.__file__).resolve())],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        env=_environment(folder),
        cwd=folder,
    )
    try:
        if program.stdout is None or program.stdout.readline().strip() != "ready":
            raise RequestError(f"the mapctl of {folder} cannot be timed: see above")
        yield program
    finally:
        program.kill()
        program.communicate()


def _ask(program: "subprocess.Popen[str]") -> list[float]:
    assert program.stdin is not None
    assert program.stdout is not None
    program.stdin.write("\n")
    program.stdin.flush()
    answer = program.stdout.readline().split()
    if len(answer) != len(_JOBS):
        raise RequestError("a timed mapctl ended by itself: see above")
    return [float(each) for each in answer]


def _time_start_up(folder: Path) -> float:
    """Processor time of a whole `mapctl follow line:3 --seconds 1`, milliseconds; wall clock where it is not known."""
    with tempfile.TemporaryDirectory() as out:
        began, before = time.perf_counter(), measure_children_seconds()
        command = [sys.executable, "-P", "-m", "mapctl", *_START_UP, str(Path(out) / "walk.bvh")]
        done = subprocess.run(command, env=_environment(folder), cwd=folder, capture_output=True, text=True)
        wall, used = time.perf_counter() - began, measure_children_seconds() - before
    if done.returncode:
        raise RequestError(f"the mapctl of {folder} cannot follow: {done.stderr.strip()[-300:]}")
    return 1000 * (wall if math.isnan(used) else used)
