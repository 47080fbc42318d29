"""mapctl as a process of its own: found, started, read, ended."""

import os
import re
import shlex
import shutil
import subprocess
import threading
from collections.abc import Callable, Generator, Sequence
from functools import cache
from pathlib import Path
from typing import IO, NamedTuple


class AddonError(Exception):
    """A reason, in one line, why nothing was changed, and what can be done about it."""


class Step(NamedTuple):
    """How far a job is."""

    label: str
    done: int = 0
    total: int = 0
    """Work in all; 0 where that is not known."""
    idle: bool = False
    """Whether the job waits for another process, so that asking again at once leads nowhere."""

    def describe(self) -> str:
        return f"{self.label} {100 * self.done // self.total} %" if self.total else self.label


OLDEST = (0, 1, 0)
"""The oldest mapctl whose commands and files are those that this add-on uses."""
_WHERE = "Edit > Preferences > Add-ons > mapctl"
_PATIENCE = 60.0  # seconds for `mapctl --version`, which is slow only where a disk is
_GRACE = 2.0  # seconds between asking a process to end and ending it
_PROGRESS = re.compile(r"progress (\d+)/(\d+) (.*)")
_NO_WINDOW = getattr(subprocess, "CREATE_NO_WINDOW", 0)  # on Windows


def find_command(preference: str) -> tuple[str, ...]:
    """Find the words that start mapctl: those of the preference, the program on PATH, or a Python that has it.

    AddonError where there is none, or an older one than OLDEST.
    """
    preference = preference.strip()
    if preference:
        words = (preference,) if shutil.which(preference) else tuple(shlex.split(preference, posix=os.name != "nt"))
        if not shutil.which(words[0]):
            raise AddonError(f"{preference}: no such program; set mapctl's path in {_WHERE}")
        version = read_version(words)
    else:
        candidates = [("mapctl",), ("python3", "-m", "mapctl"), ("python", "-m", "mapctl")]
        candidates = [(path, *rest) for name, *rest in candidates if (path := shutil.which(name))]
        found = [(each, version) for each in candidates if (version := read_version(each))]
        if not found:
            raise AddonError(f"mapctl was not found: pip install mapctl, then set its path in {_WHERE}")
        words, version = found[0]
    if not version:
        raise AddonError(f"{shlex.join(words)} does not answer like mapctl; set the command in {_WHERE}")
    if version < OLDEST:
        shown, needed = (".".join(map(str, numbers)) for numbers in (version, OLDEST))
        raise AddonError(f"mapctl {shown} is too old, {needed} or later is needed: pip install --upgrade mapctl")
    return words


@cache
def read_version(words: tuple[str, ...]) -> tuple[int, ...]:
    """Ask a command for its version; nothing where it gives none as mapctl does."""
    try:
        answer = subprocess.run(
            [*words, "--version"], capture_output=True, text=True, timeout=_PATIENCE, creationflags=_NO_WINDOW
        ).stdout
    except (OSError, ValueError, subprocess.SubprocessError):
        return ()
    found = re.match(r"mapctl (\d+)\.(\d+)(?:\.(\d+))?", answer)
    return tuple(int(number or 0) for number in found.groups()) if found else ()


class Process:
    """A command that runs. Its output is read by threads, so that it never waits for this program."""

    def __init__(self, words: Sequence[str | Path], folder: Path):
        """Start it in a folder; AddonError where the system refuses."""
        self.lines: list[str] = []
        """Lines on standard output so far."""
        self.errors: list[str] = []
        """Lines on standard error so far, without those of progress."""
        self.step = Step("starting mapctl", idle=True)
        """Its last line of progress."""
        try:
            self._process = subprocess.Popen(
                [str(word) for word in words],
                cwd=folder,
                env={**os.environ, "MAPCTL_PROGRESS": "1", "PYTHONIOENCODING": "utf-8"},
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE,
                stderr=subprocess.PIPE,
                encoding="utf-8",
                errors="replace",
                creationflags=_NO_WINDOW,
            )
        except OSError as error:
            raise AddonError(f"{words[0]} cannot be started: {error.strerror or error}") from error
        pipes = (self._process.stdout, self.lines.append), (self._process.stderr, self._read_error)
        self._threads = [threading.Thread(target=_read_lines, args=pipe, daemon=True) for pipe in pipes]
        for thread in self._threads:
            thread.start()

    @property
    def running(self) -> bool:
        return self._process.poll() is None

    def check(self) -> None:
        """Wait for the end of its output; AddonError with its last error where it failed."""
        for thread in self._threads:
            thread.join()
        if self._process.wait() != 0:
            lines = [f"it ended with status {self._process.returncode}", *filter(str.strip, self.errors)]
            own = [line for line in lines if line.startswith("mapctl: ")]
            raise AddonError((own or lines)[-1].removeprefix("mapctl: "))

    def end(self) -> None:
        """End it if it still runs: ask first, then insist."""
        if not self.running:
            return
        self._process.terminate()
        try:
            self._process.wait(_GRACE)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()

    def _read_error(self, line: str) -> None:
        found = _PROGRESS.match(line)
        if found is None:
            self.errors.append(line)
        else:
            self.step = Step(found[3], int(found[1]), int(found[2]), idle=True)


def run_command(words: Sequence[str | Path], folder: Path, label: str) -> Generator[Step, None, list[str]]:
    """Run a command to its end, step by step, and return its lines on standard output; whoever closes the iterator
    ends the command. AddonError with what it said where it fails."""
    process = Process(words, folder)
    try:
        while process.running:
            yield process.step if process.step.total else Step(label, idle=True)
        process.check()
        return process.lines
    finally:
        process.end()


def _read_lines(pipe: IO[str], take: Callable[[str], None]) -> None:
    with pipe:
        for line in pipe:
            take(line.rstrip("\n"))
