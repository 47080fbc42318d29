"""Models trained by processes of their own, several at once, each after those that it needs."""

import os
import queue
import signal
import subprocess
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from threading import Thread

from mapctl.commands.train.whole_set.plan import Job

Say = Callable[[str, str], None]
"""Told a model's name and a line of its process."""
_ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")
_END_SECONDS = 120.0  # that a process is given to save a checkpoint


class Worker:
    """A process that trains one model; Ctrl-C does not reach it, whoever started it tells it to end."""

    def __init__(self, name: str, words: Sequence[str], *, lock: int | None, say: Say, ended: Callable[[str], None]):
        """`words` are those of a command line; `ended` is called, in a thread of its own, when the process is gone."""
        self.name, self.last = name, ""
        self._say, self._ended = say, ended
        self._process = subprocess.Popen(
            [sys.executable, "-m", "mapctl", *words[1:]],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            encoding="utf-8",
            errors="replace",
            env={**os.environ, **_ONE_THREAD},
            pass_fds=() if lock is None else (lock,),
            start_new_session=True,
        )
        self._reader = Thread(target=self._read, daemon=True)
        self._reader.start()

    def _read(self) -> None:
        assert self._process.stdout is not None
        try:
            for line in self._process.stdout:
                self.last = line.rstrip() or self.last
                self._say(self.name, line.rstrip())
        except OSError:  # nobody reads what is said: that must not end a run of hours
            self._process.stdout.read()
        finally:
            self._process.wait()
            self._ended(self.name)

    @property
    def status(self) -> int | None:
        """Exit status; None while it goes on."""
        return self._process.poll()

    def stop(self) -> None:
        """Tell it to save a checkpoint and end."""
        if self._process.poll() is None:
            self._process.send_signal(signal.SIGTERM)

    def wait(self) -> None:
        """Wait for its end; a process that does not save in time is killed, and its last checkpoint stays."""
        try:
            self._process.wait(_END_SECONDS)
        except subprocess.TimeoutExpired:
            self._process.kill()
        self._reader.join()


def train_jobs(
    jobs: Sequence[Job],
    count: int,
    *,
    start: Callable[[Job], list[str]],
    lock: int | None,
    say: Say,
    finish: Callable[[Job], None],
) -> dict[str, str]:
    """Train all that is not finished, `count` at once; `start` gives the words of a model's command when it begins, and
    `finish` is called with each that is finished, also before. Returns why models are not, by their names.

    One that fails does not end the others, but for those that need it. KeyboardInterrupt once all that ran have saved.
    """
    ended: queue.SimpleQueue[str] = queue.SimpleQueue()
    running: dict[str, Worker] = {}
    failed: dict[str, str] = {}
    waiting = {job.model.name: job for job in jobs}
    by_name = dict(waiting)
    for name in [name for name, job in waiting.items() if job.finished]:
        say(name, "is finished")
        finish(waiting.pop(name))
    try:
        while waiting or running:
            failed |= _fail_dependents(waiting, failed)
            for job in _list_ready(waiting, running)[: count - len(running)]:
                name = job.model.name
                del waiting[name]
                running[name] = Worker(name, start(job), lock=lock, say=say, ended=ended.put)
            if not running:
                continue
            done = running.pop(ended.get())
            if done.status == 0 and by_name[done.name].finished:
                finish(by_name[done.name])
            else:
                failed[done.name] = done.last.removeprefix("mapctl: ") or f"its process ended with {done.status}"
    except BaseException:
        _end_all(running.values())
        raise
    return failed


def _list_ready(waiting: Mapping[str, Job], running: Iterable[str]) -> list[Job]:
    """Those whose needs are neither to come nor under way."""
    to_come = {*waiting, *running}
    return [job for job in waiting.values() if not to_come & set(job.model.needs.values())]


def _fail_dependents(waiting: dict[str, Job], failed: dict[str, str]) -> dict[str, str]:
    """Take those out that need one that has failed."""
    found: dict[str, str] = {}
    for name, job in list(waiting.items()):
        lost = [need for need in job.model.needs.values() if need in failed or need in found]
        if lost:
            found[name] = f"needs {lost[0]}"
            del waiting[name]
    return found


def _end_all(workers: Iterable[Worker]) -> None:
    """Tell all to end, then wait for each."""
    workers = list(workers)
    for each in workers:
        each.stop()
    for each in workers:
        each.wait()
