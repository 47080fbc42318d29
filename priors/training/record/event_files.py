"""The losses of a run for TensorBoard, in RUN/tensorboard, where that package is installed."""

from importlib.util import find_spec
from pathlib import Path
from typing import Any

from priors.training.record.watching import Row, RunStart, Watcher

FOLDER = "tensorboard"
"""Of the event files in the run folder."""


class EventFiles(Watcher):
    """Writes event files; does nothing, and imports nothing, where TensorBoard is not installed."""

    def __init__(self, run: Path):
        self._folder = run / FOLDER
        self._writer: Any = None

    def begin(self, start: RunStart) -> None:
        """Open the files; what a run that was killed has told beyond its checkpoint is taken back."""
        if find_spec("tensorboard") is None:
            return
        from torch.utils.tensorboard.writer import SummaryWriter  # an optional extra, slow to import

        self._writer = SummaryWriter(str(self._folder), purge_step=start.step + 1 if start.step else None)

    def see_losses(self, step: int, means: Row) -> None:
        """A point of each loss."""
        self._add("training", step, means)

    def see_validation(self, step: int, measures: Row) -> None:
        """A point of each measure."""
        self._add("validation", step, measures)
        if self._writer is not None:
            self._writer.flush()

    def end(self) -> None:
        """Close the files."""
        if self._writer is not None:
            self._writer.close()
            self._writer = None

    def _add(self, part: str, step: int, row: Row) -> None:
        if self._writer is None:
            return
        for name, value in row.items():
            if value is not None:
                self._writer.add_scalar(f"{part}/{name}", value, step)
