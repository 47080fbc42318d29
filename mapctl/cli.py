"""The command line: parse, run one command, turn errors into exit statuses. Nothing imports this module.

Exit status: 0 done; 1 nobody read the output; 2 the input or the command is wrong or a disk is full, with one line on
standard error and nothing written; 3 done, but not all that was asked holds (--strict);
130 interrupted (Ctrl-C), 143 terminated (SIGTERM), 129 the terminal was closed: what was solved until then is written.
"""

import io
import os
import re
import signal
import sys
import threading
import time
import traceback
from collections.abc import Mapping, Sequence
from contextlib import redirect_stderr
from dataclasses import make_dataclass
from functools import reduce
from operator import or_
from types import FrameType
from typing import Annotated, Any

import tyro

from mapctl import __version__
from mapctl.commands import COMMANDS, MANY_THREADS, load_command
from mapctl.commands.shared.command import INTERRUPTED, INVALID, SIGNALLED, UNREAD, describe_error, use_single_thread
from mapctl.commands.train import RECIPES, load_recipe
from mapctl.errors import MapctlError, RequestError

_ANSI_COLOUR = re.compile(r"\x1b\[[\d;]*m")
_HINT = re.compile(r"Available subcommands: .*|Perhaps you meant: -[\w-]+")
_MESSAGE_REWRITES = (
    (r" Got errors:.*", ""),
    (r"no type matching (.+) could be instantiated from \[(.*?)\]", r"expected \1, got \2"),
    (r"invalid literal for int\(\) with base 10: ", "expected a whole number, got "),
    (r"could not convert string to float: ", "expected a number, got "),
    (r"expected \{None\}\|FLOAT", "expected a number"),
    (r"expected \{None\}\|INT", "expected a whole number"),
    (r" \(required\)", ""),
    (r" \(applied to [\w -]+\)", ""),
    (r" Arguments are applied to .*", ""),
    (r" or misplaced options", " options"),
)
"""Messages of Python and tyro, and those shown instead."""
STYLE = (tyro.conf.OmitArgPrefixes, tyro.conf.FlagCreatePairsOff)


def main(argv: Sequence[str] | None = None) -> int:
    """Run `mapctl` with the given words (those of the process if None); returns the exit status."""
    received = _raise_on_signals() if argv is None else []
    words = list(sys.argv[1:] if argv is None else argv)
    try:
        status = _print_version() if words == ["--version"] else parse(words).run()
        sys.stdout.flush()
        if status == INTERRUPTED:
            status = _report_interruption(received, "what was solved until then is written")
    except KeyboardInterrupt as stop:
        status = _report_interruption(received, str(stop))
    except BrokenPipeError:
        _discard_output()
        status = UNREAD
    except (MapctlError, ModuleNotFoundError, OSError) as error:
        if isinstance(error, OSError):
            _discard_output()
        status = _print_error(describe_error(error), INVALID)
    return status


def parse(words: Sequence[str]) -> Any:
    """The command that the words ask for. RequestError where there is none; SystemExit after --help."""
    name, *others = words or [""]
    if name not in COMMANDS:
        # Stand-ins: the commands themselves take seconds to import.
        summaries = {
            name: make_dataclass(kind, (), namespace={"__doc__": text}) for name, (kind, text) in COMMANDS.items()
        }
        return _read_options(_join(summaries), words, "mapctl", _DESCRIPTION)
    if name not in MANY_THREADS:
        use_single_thread()
    command = load_command(name)
    kind = _join({each: load_recipe(each) for each in RECIPES}) if name == "train" else command
    return _read_options(kind, others, f"mapctl {name}", command.__doc__ or "")


def _join(kinds: Mapping[str, type]) -> Any:
    named = {name: tyro.conf.subcommand(name, prefix_name=False) for name in kinds}
    return reduce(or_, (Annotated[kind, named[name]] for name, kind in kinds.items()))


def _read_options(kind: Any, words: Sequence[str], prog: str, description: str) -> Any:
    explained = io.StringIO()
    try:
        with redirect_stderr(explained):
            return tyro.cli(kind, prog=prog, description=description, args=list(words), config=STYLE)
    except SystemExit as stop:
        if stop.code == 0:
            raise
        helped = [prog, *(word for word in words[:1] if prog == "mapctl train" and word in RECIPES), "--help"]
        raise RequestError(f"{_shorten_usage_error(explained.getvalue())} (see {' '.join(helped)})") from None


_DESCRIPTION = (
    "Human motion that does what a person asks and still looks captured: BVH in, BVH out.\n"
    "`mapctl COMMAND --help` shows a command's options; `mapctl --version` the version.\n"
    "`example:noisy-walk` in place of a motion file is one that mapctl brings along."
)


def _print_version() -> int:
    print(f"mapctl {__version__}")
    return 0


def _shorten_usage_error(box: str) -> str:
    """Return tyro's boxed message as one line: its first paragraph, and a hint if there is one.

    The box has a title line, and rules between its paragraphs; colours where standard output is a terminal.
    """
    paragraphs = [""]
    for line in _ANSI_COLOUR.sub("", box).splitlines()[1:]:
        text = line.strip("│ ")
        if text and not text.strip("─-╰╯"):
            paragraphs.append("")
        else:
            paragraphs[-1] = f"{paragraphs[-1]} {text}".strip()
    first, *others = [*filter(None, paragraphs)] or ["the command cannot be understood"]
    hints = filter(None, (_HINT.match(paragraph) for paragraph in others))
    for pattern, plainer in _MESSAGE_REWRITES:
        first = re.sub(pattern, plainer, first)
    # An option that is another command's is like itself.
    shown = (hint.group() for hint in hints if hint.group().rpartition(" ")[2] not in first.split())
    return ". ".join([first.strip().rstrip("."), *shown])


def _raise_on_signals() -> list[int]:
    """Raise KeyboardInterrupt from here on at Ctrl-C, SIGTERM and a terminal that closes; the list gets their numbers.
    Schedulers and impatient fingers send a signal twice: what comes within a second is one. Ignored ones stay so."""
    received: list[int] = []
    until = 0.0

    def stop(number: int, frame: FrameType | None) -> None:
        nonlocal until
        if _is_compiling(frame):  # LLVM calls Python back, drops what is raised there, and crashes
            again = threading.Timer(0.05, _signal_main_thread, (number,))
            again.daemon = True
            again.start()
        elif time.monotonic() >= until:
            until = time.monotonic() + 1.0
            received.append(number)
            raise KeyboardInterrupt

    for name in ("SIGINT", "SIGTERM", "SIGHUP"):
        number = getattr(signal, name, None)  # Windows has no SIGHUP
        if number is not None and signal.getsignal(number) not in (signal.SIG_IGN, None):
            signal.signal(number, stop)
    return received


def _signal_main_thread(number: int) -> None:
    if hasattr(signal, "pthread_kill"):  # which ends a wait; Windows lacks it
        signal.pthread_kill(threading.main_thread().ident or 0, number)
    else:
        signal.raise_signal(number)


def _is_compiling(frame: FrameType | None) -> bool:
    return any(each.f_globals.get("__name__", "").startswith("llvmlite.") for each, _ in traceback.walk_stack(frame))


def _print_error(message: str, status: int) -> int:
    print(f"mapctl: {' '.join(message.split())}", file=sys.stderr)
    return status


def _report_interruption(received: Sequence[int], kept: str) -> int:
    """Report that work was interrupted, and the results kept; without a signal it was Ctrl-C."""
    number = received[-1] if received else signal.SIGINT
    how = "interrupted" if number == signal.SIGINT else "terminated"
    return _print_error("; ".join(filter(None, (how, kept))), SIGNALLED + number)


def _discard_output() -> None:
    """The interpreter flushes standard output once more at exit, which would fail again (see Python's signal page)."""
    try:
        sys.stdout.flush()
    except OSError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


if __name__ == "__main__":
    sys.exit(main())
