"""The loop of every training run: updates, judgements and checkpoints, and an end at any moment that loses nothing."""

import time
from typing import Protocol, runtime_checkable

from mapctl.runtime.interruption import DeferredSignals, defer_signals


@runtime_checkable
class TrainingRun(Protocol):
    """A training run. Everything that a continuation needs is in what it saves."""

    @property
    def finished(self) -> bool:
        """Whether the recipe, or training by itself, has come to its end."""
        ...

    @property
    def evaluation_due(self) -> bool:
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


def run_to_end(run: TrainingRun, *, checkpoint_minutes: float) -> None:
    """To the end of the run. Ctrl-C or SIGTERM waits for the step under way, breaks a judgement off, saves a
    checkpoint and goes on as KeyboardInterrupt; sent again after a second, it does not wait for the step, and the last
    checkpoint is the one before.
    """
    saved, unsaved = time.monotonic(), False
    with defer_signals() as held:
        while True:
            if run.evaluation_due:
                _evaluate_run(run, held)
                unsaved = True
            overdue = time.monotonic() - saved > 60 * checkpoint_minutes
            if unsaved and (run.finished or overdue or held.wanted is not None):
                _save_run(run, held)
                saved, unsaved = time.monotonic(), False
            held.release()
            if run.finished:
                return
            run.update()
            unsaved = True


def _evaluate_run(run: TrainingRun, held: DeferredSignals) -> None:
    try:
        with held.let_through():
            run.judge()
    except KeyboardInterrupt:
        _save_run(run, held)
        raise


def _save_run(run: TrainingRun, held: DeferredSignals) -> None:
    with held.defer_all():
        run.save()
