"""The training loop of every model: steps, validations, early stopping, checkpoints, and at the end weights and card.

A run folder holds `checkpoint.safetensors`, from which training resumes, `losses.csv` and `tensorboard/`, the features
of the clips in `cache/`, and at the end `model.safetensors` with its card, `model.json`.
"""

import csv
import io
import json
import math
import signal
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict
from importlib.util import find_spec
from pathlib import Path
from types import FrameType
from typing import Any, Generic

import torch
from safetensors import SafetensorError, safe_open
from torch import Tensor, nn

from mapctl.errors import CheckpointError, RequestError
from mapctl.formats.atomic import check_folder, write_text
from priors import checkpoints
from priors.checkpoints import write_tensors
from priors.training.recipe import C, Gathered, Progress, Recipe, Row, S, T, ignore_line, select_prefixed, use_device

CHECKPOINT, LOSSES, EVENTS = "checkpoint.safetensors", "losses.csv", "tensorboard"
"""Files and folder of a run folder."""
TRAINING, VALIDATION = "training", "validation"
"""What the column `part` of LOSSES holds: mean losses since the last report, or measures of held-out clips."""
_FIRST_LINE_SECONDS, _LINE_SECONDS = 5.0, 30.0  # to the first line on the losses, and from line to line
_SAME_SIGNAL_SECONDS = 1.0  # `timeout` and job schedulers send a signal twice
_UNREADABLE = (OSError, ValueError, KeyError, TypeError, AttributeError, IndexError, RuntimeError, SafetensorError)


def train(recipe: Recipe[Any, Any, Any], progress: Progress = ignore_line, *, warn: Progress = ignore_line) -> Path:
    """Train to the end of the recipe, or until validation no longer improves, and write RUN/model.safetensors; return
    its path. `progress` gets lines on losses and validations, `warn` one on files that cannot be used.

    Ctrl-C and SIGTERM save a checkpoint and go on as KeyboardInterrupt. MapctlError where training diverges; the last
    checkpoint then stays as it was.
    """
    recipe.check()
    check_folder(recipe.out)
    present = (recipe.out / CHECKPOINT).exists()
    if recipe.resume and not present:
        raise CheckpointError(f"{recipe.out} holds no checkpoint to resume from")
    if present and not recipe.resume:
        raise RequestError(f"{recipe.out} already holds a run; pass --resume to continue it, or choose another folder")
    gathered = recipe.gather(progress, warn)
    with use_device(recipe.find_device()):
        run = TrainingRun(recipe, gathered, progress)
        run.go()
        return run.export()


def read_index(run: Path) -> dict[str, Any]:
    """Read what the checkpoint of a run folder holds beside its tensors; CheckpointError where there is none."""
    return _read_checkpoint(run)[0]


class TrainingRun(Generic[C, S, T]):
    """A trainer, its curve of validations and its checkpoints."""

    def __init__(self, recipe: Recipe[C, S, T], gathered: Gathered, progress: Progress = ignore_line):
        self.recipe, self.gathered, self.progress = recipe, gathered, progress
        self.parts = gathered.parts.to(torch.get_default_device().type)
        self.trainer = recipe.make_trainer(self.parts)
        self.identity = json.loads(json.dumps(recipe.describe_run(self.trainer, gathered.corpus)))
        self.curve: list[Row] = []
        self.losses: list[Row] = []  # since the last report
        self.keeps_best = recipe.keeps_best or recipe.patience > 0
        self.best = _copy_weights(self.trainer.exported) if self.keeps_best else {}
        self.stop_reason: str | None = None
        if recipe.resume:
            self._load()
            progress(f"resumed at step {self.trainer.step}")
        self.log = Log(recipe.out, self.trainer.step)

    def go(self) -> None:
        """Train to the end of the run; see `train`."""
        saved, unsaved = time.monotonic(), False
        pace = _Pace(self.trainer.step)
        with hold_interruption() as received:
            while True:
                if self._validation_due():
                    self.validate()
                    unsaved = self.trainer.step > 0
                ended = self.stop_reason is not None or self.trainer.step >= self.trainer.steps
                overdue = time.monotonic() - saved > 60 * self.recipe.checkpoint_minutes
                if unsaved and (ended or overdue or received):
                    self.save()
                    saved, unsaved = time.monotonic(), False
                if ended or received:
                    break
                self.step(pace)
                unsaved = True
        self.log.close()

    def step(self, pace: "_Pace | None" = None) -> None:
        """Take one step, and report on the last ones where it is time."""
        recipe, trainer = self.recipe, self.trainer
        row = trainer.train_step()
        self.losses.append(row)
        last = trainer.step >= trainer.steps
        if pace is not None and (line := pace.format_line(row, trainer.step, trainer.steps)):
            self.progress(line)
        self.stop_reason = recipe.find_stop_reason(trainer, self.losses)
        if self.stop_reason is not None:
            self.progress(f"{self.stop_reason}: training ends with the best weights so far")
        if last or trainer.step % recipe.report_steps == 0:
            self.log.write(trainer.step, TRAINING, _average(self.losses))
            self.losses = []

    def validate(self) -> None:
        """Measure the weights as they are, and stop where `patience` validations have brought nothing better."""
        recipe, trainer = self.recipe, self.trainer
        if not self.keeps_best:
            trainer.check_finite()
        row = _none_where_not_finite(trainer.validate(self.parts.validation))
        scores = [_rank(recipe.score(each)) for each in [*self.curve, row]]
        if self.keeps_best and all(scores[-1] < before for before in scores[:-1]):
            self.best = _copy_weights(trainer.exported)
        self.curve.append({"step": trainer.step, **row})
        self.log.write(trainer.step, VALIDATION, row)
        measures = ", ".join(f"{name} {'-' if value is None else f'{value:.4g}'}" for name, value in row.items())
        self.progress(f"validation at step {trainer.step}: {measures}")
        stale = len(scores) - 1 - min(range(len(scores)), key=scores.__getitem__)
        if recipe.patience and stale >= recipe.patience:
            self.stop_reason = f"no better in {recipe.patience} validations"
            self.progress(f"{self.stop_reason}: training ends with the best weights so far")

    def save(self) -> None:
        """Write a checkpoint, unless training was stopped, since what is resumed comes to the same end; MapctlError
        where the weights are not finite."""
        if self.stop_reason is not None:
            return
        if not self.keeps_best:
            self.trainer.check_finite()
        index = {
            "step": self.trainer.step,
            "steps": self.trainer.steps,
            "licence": self.recipe.licence,
            "identity": self.identity,
            "curve": self.curve,
        }
        tensors = self.trainer.state() | {f"best.{name}": value for name, value in self.best.items()}
        write_tensors(self.recipe.out / CHECKPOINT, tensors, metadata={"run": json.dumps(index)})

    def export(self) -> Path:
        """Write the model with its card."""
        recipe, path = self.recipe, self.recipe.out / "model.safetensors"
        if self.keeps_best:
            self.trainer.exported.load_state_dict(self.best)
        for network in self.trainer.networks().values():
            network.to("cpu")
        recipe.finish(self.trainer)
        exported = recipe.export(self.trainer, self.gathered, self.curve)
        ended = {} if self.stop_reason is None else {"ended": f"step {self.trainer.step}: {self.stop_reason}"}
        card = checkpoints.Card(
            kind=recipe.kind,
            config=recipe.find_shape(self.trainer).as_card(),
            licence=recipe.licence,
            data={**exported.data, **recipe.describe_origin(), "trained_on": self.gathered.describe_training()},
            training={"settings": asdict(recipe.settings), "curve": self.curve, **ended},
            quality=exported.quality,
            abilities=exported.abilities,
            **checkpoints.Card.layout_fields(),
        )
        checkpoints.save(dict(exported.tensors), card, path, half=exported.half)
        return path

    def _validation_due(self) -> bool:
        """Whether the weights have still to be measured: every so many steps and at the end, and, where a recipe keeps
        the best, before the first step."""
        if self.recipe.keeps_best and not self.curve:
            return True
        step, measured = self.trainer.step, self.curve[-1]["step"] if self.curve else 0
        due = step >= self.trainer.steps or step % self.recipe.validate_steps == 0
        return due and step > measured and self.stop_reason is None

    def _load(self) -> None:
        index, tensors = _read_checkpoint(self.recipe.out)
        try:
            for part, now in self.identity.items():
                then = index["identity"][part]
                changed = [f"{key}: {then.get(key)} then, {now[key]} now" for key in now if then.get(key) != now[key]]
                if changed:
                    raise CheckpointError(
                        f"{self.recipe.out}: the run was begun with other {part} ({'; '.join(changed)})"
                    )
            self.curve = [{**row, "step": int(row["step"])} for row in index["curve"]]
            self.trainer.load_state(tensors, int(index["step"]))
            if self.keeps_best:  # a run that was begun without patience kept none
                self.best = select_prefixed("best.", tensors) or _copy_weights(self.trainer.exported)
        except _UNREADABLE as error:
            raise _make_unreadable_error(self.recipe.out, error) from error
        if self.trainer.step > self.trainer.steps:
            done, wanted = self.trainer.step, self.trainer.steps
            raise RequestError(f"{self.recipe.out}: {done} steps are done; --steps must be at least that, got {wanted}")


class Log:
    """Mean losses and measures of held-out clips, as RUN/losses.csv and, where it is installed, for TensorBoard."""

    def __init__(self, run: Path, step: int):
        """Rows beyond `step`, at which the run goes on, are dropped: they come again."""
        self._path, self._rows = run / LOSSES, _read_rows(run / LOSSES, step)
        self._events: Any = None
        if find_spec("tensorboard") is not None:
            from torch.utils.tensorboard.writer import SummaryWriter  # an optional extra, slow to import

            self._events = SummaryWriter(str(run / EVENTS), purge_step=step + 1 if step else None)

    def write(self, step: int, part: str, values: Mapping[str, Any]) -> None:
        """Add a row; values that are not finite numbers are left out."""
        finite = {name: v for name, v in values.items() if isinstance(v, int | float) and math.isfinite(v)}
        self._rows.append({"step": str(step), "part": part, **{name: f"{v:.9g}" for name, v in finite.items()}})
        text = io.StringIO()
        columns = dict.fromkeys(name for row in self._rows for name in row)
        table = csv.DictWriter(text, list(columns), lineterminator="\n")
        table.writeheader()
        table.writerows(self._rows)
        write_text(self._path, text.getvalue())
        if self._events is not None:
            for name, value in finite.items():
                self._events.add_scalar(f"{part}/{name}", value, step)
            self._events.flush()

    def close(self) -> None:
        """Close the event files."""
        if self._events is not None:
            self._events.close()


@contextmanager
def hold_interruption() -> Iterator[list[int]]:
    """Collect SIGINT and SIGTERM within, so that a step ends before training does; afterwards the first is sent again.
    One that comes a second after another interrupts at once. In other threads than the main one nothing is held."""
    received: list[int] = []
    if threading.current_thread() is not threading.main_thread():
        yield received
        return
    first = math.inf

    def note(number: int, frame: FrameType | None) -> None:
        nonlocal first
        if received and time.monotonic() > first + _SAME_SIGNAL_SECONDS:
            raise KeyboardInterrupt
        if not received:
            first = time.monotonic()
            received.append(number)

    handlers = {number: signal.signal(number, note) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield received
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)
    if received:
        signal.raise_signal(received[0])


class _Pace:
    """Says by the clock how far a run has come."""

    def __init__(self, step: int):
        self._rows: list[Row] = []
        self._step, self._began = step, time.monotonic()
        self._due = self._began + _FIRST_LINE_SECONDS

    def format_line(self, row: Row, step: int, steps: int) -> str | None:
        """Format the mean losses since the last line, the rate and the time left; None before it is time."""
        self._rows.append(row)
        now = time.monotonic()
        if now < self._due and step < steps:
            return None
        rate = (step - self._step) / max(1e-9, now - self._began)
        left = round((steps - step) / rate)
        losses = ", ".join(f"{name} {value:.3f}" for name, value in _average(self._rows).items())
        self._rows, self._due = [], now + _LINE_SECONDS
        clock = f"{left // 3600}:{left // 60 % 60:02d}:{left % 60:02d}"
        return f"step {step}/{steps}: {losses}, {rate:.3g} steps/s, {clock} left"


def _average(rows: Sequence[Row]) -> Row:
    """Mean of each loss over the rows that have it."""
    names = dict.fromkeys(name for row in rows for name in row)
    found = {name: [row[name] for row in rows if name in row] for name in names}
    return {name: sum(values) / len(values) for name, values in found.items()}


def _read_rows(path: Path, step: int) -> list[dict[str, str]]:
    """Read the rows of a table up to a step; none where it is gone or damaged."""
    try:
        with path.open(encoding="utf-8", newline="") as file:
            rows = [{name: cell for name, cell in row.items() if cell} for row in csv.DictReader(file)]
        return [row for row in rows if int(row["step"]) <= step] if step else []
    except (OSError, ValueError, KeyError, TypeError, csv.Error):
        return []


def _read_checkpoint(run: Path) -> tuple[dict[str, Any], dict[str, Tensor]]:
    """Read index and tensors; CheckpointError where they cannot be read."""
    try:
        with safe_open(run / CHECKPOINT, framework="pt") as file:
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
            index = json.loads(file.metadata()["run"])
            return {**index, "step": int(index["step"])}, tensors
    except _UNREADABLE as error:
        raise _make_unreadable_error(run, error) from error


def _make_unreadable_error(run: Path, error: Exception) -> CheckpointError:
    return CheckpointError(f"{run}: no readable checkpoint ({' '.join(f'{type(error).__name__}: {error}'.split())})")


def _rank(score: float) -> float:
    return math.inf if math.isnan(score) else score


def _copy_weights(network: nn.Module) -> dict[str, Tensor]:
    return {name: value.clone() for name, value in network.state_dict().items()}


def _none_where_not_finite(row: Row) -> Row:
    return {name: value if math.isfinite(value) else None for name, value in row.items()}
