"""The loop of every training run: updates, judgements and checkpoints, and an end at any moment that loses nothing."""

import time
from typing import Protocol, runtime_checkable

from mapctl.runtime.interruption import Held, held_back


@runtime_checkable
class Run(Protocol):
    """A training run. Everything that a continuation needs is in what it saves."""

    @property
    def finished(self) -> bool:
        """Whether the recipe, or training by itself, has come to its end."""
        ...

    @property
    def judgement_due(self) -> bool:
        """Whether the weights as they are have still to be measured on held-out clips."""
        ...

    def update(self) -> None:
        """One step. Half of it is of no use."""
        ...

    def judge(self) -> None:
        """Measure. It may be broken off and begun again: until its end it changes nothing."""
        ...

    def save(self) -> None:
        """Write a checkpoint."""
        ...


def go(run: Run, *, checkpoint_minutes: float) -> None:
    """To the end of the run. Ctrl-C or SIGTERM waits for the step under way, breaks a judgement off, saves a
    checkpoint and goes on as KeyboardInterrupt; sent again after a second, it does not wait for the step, and the last
    checkpoint is the one before.
    """
    saved, unsaved = time.monotonic(), False
    with held_back() as held:
        while True:
            if run.judgement_due:
                _judge(run, held)
                unsaved = True
            overdue = time.monotonic() - saved > 60 * checkpoint_minutes
            if unsaved and (run.finished or overdue or held.wanted is not None):
                _save(run, held)
                saved, unsaved = time.monotonic(), False
            held.release()
            if run.finished:
                return
            run.update()
            unsaved = True


def _judge(run: Run, held: Held) -> None:
    try:
        with held.passing():
            run.judge()
    except KeyboardInterrupt:
        _save(run, held)
        raise


def _save(run: Run, held: Held) -> None:
    with held.shut():
        run.save()
