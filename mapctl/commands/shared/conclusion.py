"""How a command ends whose work is a solve."""

from mapctl.commands.shared import exit_status
from mapctl.problem.solution import Outcome, Status


def conclude(status: Status, *, strict: bool) -> int:
    """Return the exit status of a command whose solve ended so; strict ones fail where not all that was asked holds."""
    if status.outcome is Outcome.INTERRUPTED:
        return exit_status.INTERRUPTED
    return exit_status.NOT_SATISFIED if strict and not status.ok else 0
