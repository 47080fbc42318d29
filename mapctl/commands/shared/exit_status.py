"""Exit statuses of all commands besides 0, which means that all is written."""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from mapctl.problem.solution import Status

UNREAD = 1
"""The output was not read: a broken pipe."""
INVALID = 2
"""The input or the command is wrong, or a disk is full."""
NOT_SATISFIED = 3
"""Done, but not all that was requested holds."""
SIGNALLED = 128
"""Ended by a signal, whose number is added."""
INTERRUPTED = 130
"""Ctrl-C; what was solved until then is written, films are not."""


def conclude(status: "Status", *, strict: bool) -> int:
    """Return the exit status of a command whose solve ended so; strict ones fail where not all that was asked holds."""
    from mapctl.problem.solution import Outcome  # not needed for --help

    if status.outcome is Outcome.INTERRUPTED:
        return INTERRUPTED
    return NOT_SATISFIED if strict and not status.ok else 0
