"""A training run: from a recipe to a run folder with a checkpoint, a curve and a loadable model with its card.

One loop for every model: updates, validations and checkpoints, and an end at any moment that loses nothing.
"""

import json
import math
import time
from dataclasses import asdict
from pathlib import Path
from typing import Any, Generic

from torch import Tensor

from mapctl.runtime.interruption import DeferredSignals, defer_signals
from priors import checkpoints
from priors.training import run_files
from priors.training.gathering import Progress, gather
from priors.training.recipe import C, Gathered, Recipe, Row, S, T, average, copy_weights


def train(
    recipe: Recipe[Any, Any, Any], progress: Progress = lambda line: None, *, warn: Progress = lambda line: None
) -> Path:
    """Train to the end of the recipe, or until its guard stops it, and write RUN/model.safetensors; returns its path.
    `warn` is told of files that cannot be used.

    Ctrl-C and SIGTERM save a checkpoint and go on as KeyboardInterrupt. Interrupted or killed and resumed, a run gives
    the same weights bit for bit on one machine. MapctlError where training diverges and no guard sees it; the last
    checkpoint then stays as it was.
    """
    recipe.check()
    run_files.check_run_folder(recipe.out, resume=recipe.resume)
    gathered = Gathered(*gather(recipe.source(), progress=progress, warn=warn))
    run = TrainingRun(recipe, gathered, progress)
    run.go()
    return run.export()


class TrainingRun(Generic[C, S, T]):
    """A trainer, its curve and its checkpoints. Everything that a continuation needs is in what it saves."""

    def __init__(self, recipe: Recipe[C, S, T], gathered: Gathered, progress: Progress):
        self.recipe, self.gathered, self.progress = recipe, gathered, progress
        self.trainer = recipe.make_trainer(gathered.parts)
        self.pinned = json.loads(json.dumps(recipe.pin(self.trainer, gathered.corpus)))
        self.curve: list[Row] = []
        self.losses: list[Row] = []  # since the last line of news but one, where there has just been one
        self.stop_reason: str | None = None
        self.started_at = time.monotonic()
        self.best: dict[str, Tensor] = copy_weights(self.trainer.network) if recipe.guards else {}
        if recipe.resume:
            self._load()
            progress(f"resumed at {recipe.counter} {self.trainer.step}")
        else:
            recipe.out.mkdir(parents=True, exist_ok=True)
            if recipe.guards:
                self.judge()

    @property
    def finished(self) -> bool:
        """At the end of the recipe, or where its guard has stopped it."""
        return self.stop_reason is not None or self.trainer.step >= self.trainer.steps

    @property
    def evaluation_due(self) -> bool:
        """Whether the weights as they are have still to be measured: every so many steps and at the end."""
        step, measured = self.trainer.step, self.curve[-1][self.recipe.counter] if self.curve else 0
        due = step >= self.trainer.steps or step % self.recipe.validate_steps == 0
        return due and step > measured and self.stop_reason is None

    def go(self) -> None:
        """To the end of the run. Ctrl-C or SIGTERM waits for the step under way, breaks a judgement off, saves a
        checkpoint and goes on as KeyboardInterrupt; sent again after a second, it does not wait for the step, and the
        last checkpoint is the one before.
        """
        saved, unsaved = time.monotonic(), False
        with defer_signals() as held:
            while True:
                if self.evaluation_due:
                    self._evaluate(held)
                    unsaved = True
                overdue = time.monotonic() - saved > 60 * self.recipe.checkpoint_minutes
                if unsaved and (self.finished or overdue or held.wanted is not None):
                    self._save_undisturbed(held)
                    saved, unsaved = time.monotonic(), False
                held.release()
                if self.finished:
                    return
                self.update()
                unsaved = True

    def update(self) -> None:
        """One step, of which half is of no use."""
        recipe, trainer = self.recipe, self.trainer
        if trainer.step % recipe.report_steps == 0:
            self.losses = []
        self.losses.append(trainer.train_step())
        if trainer.step >= trainer.steps or trainer.step % recipe.report_steps == 0:
            seconds = time.monotonic() - self.started_at
            self.progress(f"{recipe.counter} {trainer.step}: {recipe.format_news(self.losses)}, {seconds:.0f} s")
        self.stop_reason = recipe.find_stop_reason(trainer, self.losses)
        if self.stop_reason is not None:
            self.progress(f"{self.stop_reason}: training ends with the best {recipe.kind} seen")

    def judge(self) -> None:
        """A row of the curve. It may be broken off and begun again: until its end it changes nothing."""
        recipe, trainer = self.recipe, self.trainer
        if not recipe.guards:
            trainer.check_finite()
        row = trainer.validate(self.gathered.parts.validation)
        if recipe.guards:
            score = recipe.score(row)
            if score < min((recipe.score(before) for before in self.curve), default=math.inf) or not self.curve:
                self.best = copy_weights(trainer.network)
            row = {**row, "score": score, **{f"training_{name}": average(self.losses, name) for name in self._watched}}
        self.curve.append({recipe.counter: trainer.step, **_none_where_not_finite(row)})
        self.progress(json.dumps(self.curve[-1]))

    def export(self) -> Path:
        """Write the model with its card."""
        recipe, path = self.recipe, self.recipe.out / "model.safetensors"
        if recipe.guards:
            self.trainer.network.load_state_dict(self.best)
        made = recipe.export(self.trainer, self.gathered, self.curve)
        card = checkpoints.Card(
            kind=recipe.kind,
            config=recipe.find_shape(self.trainer).as_card(),
            licence=recipe.licence,
            data=made.data,
            training={"settings": asdict(recipe.settings), "curve": self.curve, "command": recipe.format_command()},
            quality=made.quality,
            abilities=made.abilities,
            **checkpoints.Card.layout_fields(),
        )
        checkpoints.save(dict(made.tensors), card, path, half=made.half)
        return path

    def save(self) -> None:
        """A checkpoint. None where the guard has stopped training, since what is resumed there comes to the same end;
        MapctlError, and none, where the weights are no numbers.
        """
        if self.stop_reason is not None:
            return
        tensors, index = self.trainer.state(), {**self.pinned, "curve": self.curve}
        if self.recipe.guards:
            tensors |= {f"best.{name}": value for name, value in self.best.items()}
            index["losses"] = [{name: row[name] for name in self.recipe.guards} for row in self.losses]
        else:
            self.trainer.check_finite()
        run_files.write_checkpoint(self.recipe.out, step=self.trainer.step, tensors=tensors, index=index)

    @property
    def _watched(self) -> tuple[str, ...]:
        """Losses that there are already."""
        return self.recipe.guards if self.losses else ()

    def _evaluate(self, held: DeferredSignals) -> None:
        try:
            with held.let_through():
                self.judge()
        except KeyboardInterrupt:
            self._save_undisturbed(held)
            raise

    def _save_undisturbed(self, held: DeferredSignals) -> None:
        with held.defer_all():
            self.save()

    def _load(self) -> None:
        out, recipe = self.recipe.out, self.recipe
        try:
            index, tensors = run_files.read_checkpoint(out)
            for part, now in self.pinned.items():
                run_files.check_unchanged(out, part, then=index[part], now=now)
            self.curve = run_files.parse_curve(index, recipe.counter)
            if recipe.guards:
                self.losses = [{name: float(row[name]) for name in recipe.guards} for row in index["losses"]]
                self.best = {name: tensors[f"best.{name}"] for name in self.best}
            self.trainer.load_state(tensors, int(index["step"]))
        except run_files.UNREADABLE_ERRORS as error:
            raise run_files.make_unreadable_error(out, error) from error


def _none_where_not_finite(row: Row) -> Row:
    return {name: value if math.isfinite(value) else None for name, value in row.items()}
