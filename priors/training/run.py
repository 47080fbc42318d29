"""A training run: from a recipe to a run folder with a checkpoint, a curve and a loadable model with its card.

One loop for every model: updates, validations and checkpoints, and an end at any moment that loses nothing. Where
several processes train together, each runs this loop; the first one validates, writes and speaks.
"""

import json
import math
import time
from collections.abc import Sequence
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any, Generic

import torch
from torch import Tensor, nn

from mapctl.errors import RequestError
from mapctl.runtime.interruption import DeferredSignals, defer_signals
from priors import checkpoints
from priors.training import parallel, run_files
from priors.training.devices import find_precision, has_bfloat16, use_device
from priors.training.ending.course import Course
from priors.training.gathering import Progress, describe_origin, gather
from priors.training.parallel import ALONE, TrainingGroup
from priors.training.recipe import C, Gathered, Recipe, Row, S, T, average
from priors.training.record.event_files import EventFiles
from priors.training.record.losses_file import LossesFile
from priors.training.record.watching import LineWatcher, RunStart, Watcher


def _say_nothing(line: str) -> None:
    pass


def train(
    recipe: Recipe[Any, Any, Any],
    progress: Progress = _say_nothing,
    *,
    warn: Progress = _say_nothing,
    watchers: Sequence[Watcher] | None = None,
) -> Path:
    """Train to the end of the recipe, or until its guard stops it, and write RUN/model.safetensors; returns its path.
    `warn` is told of files that cannot be used. `watchers` are told each step; unless they are given, `progress` gets a
    line at each report.

    Several processes, forked here (`recipe.processes`) or started by torchrun, share the batch of each step. Ctrl-C and
    SIGTERM save a checkpoint and go on as KeyboardInterrupt. Interrupted or killed and resumed, a run gives the same
    weights bit for bit on one machine with as many processes. MapctlError where training diverges and no guard sees it,
    or a process ends; the last checkpoint then stays as it was.
    """
    launched = parallel.count_launched()
    if launched is not None:
        if recipe.processes not in (1, launched):
            raise RequestError(f"torchrun has started {launched} processes; leave out --processes")
        recipe = replace(recipe, processes=launched)
    recipe.check()
    with parallel.join_launched() as group:
        if not group.leads:
            progress, warn, watchers = _say_nothing, _say_nothing, ()
        recipe = _fit_precision(recipe, warn)
        gathered = _gather_together(recipe, group, progress, warn)
        watchers = [LineWatcher(progress)] if watchers is None else watchers
        with use_device(recipe.find_device()):
            run = TrainingRun(recipe, gathered, progress, warn=warn, watchers=watchers, group=group)
            run.go()
        return run.export()


def _fit_precision(recipe: Recipe[Any, Any, Any], warn: Progress) -> Recipe[Any, Any, Any]:
    """The same in float32 where bfloat16 is asked for, and the processor has none; its card then tells float32."""
    if find_precision(recipe.settings) == "float32" or recipe.find_device() != "cpu" or has_bfloat16():
        return recipe
    warn("this processor does not compute in bfloat16; training computes in float32")
    return replace(recipe, settings=replace(recipe.settings, bfloat16=False))


def _gather_together(
    recipe: Recipe[Any, Any, Any], group: TrainingGroup, progress: Progress, warn: Progress
) -> Gathered:
    """The first process checks the folder and reads the clips; the others then take them from its cache, or, on another
    machine, read them themselves."""
    found: list[Gathered] = []

    def read() -> bytes:
        if group.leads:
            run_files.check_run_folder(recipe.out, resume=recipe.resume)
        found.append(Gathered(*gather(recipe.source(), progress=progress, warn=warn)))
        return b""

    group.do_first(read)
    if not group.leads:
        read()
    return found[0]


class TrainingRun(Generic[C, S, T]):
    """A trainer, its curve and its checkpoints. Everything that a continuation needs is in what it saves."""

    def __init__(
        self,
        recipe: Recipe[C, S, T],
        gathered: Gathered,
        progress: Progress,
        *,
        warn: Progress = _say_nothing,
        watchers: Sequence[Watcher] = (),
        group: TrainingGroup = ALONE,
    ):
        self.recipe, self.gathered, self.progress, self.group = recipe, gathered, progress, group
        self.device = torch.get_default_device().type
        self.parts = gathered.parts.to(self.device)
        """What is trained on and measured, where it is computed."""
        self.trainer = recipe.make_trainer(self.parts)
        self.pinned = json.loads(json.dumps(recipe.pin(self.trainer, gathered.corpus)))
        self.curve: list[Row] = []
        self.losses: list[Row] = []  # since the last report but one, where there has just been one
        self.extended: list[dict[str, int]] = []
        """Where the number of steps was changed: at which step, from what, to what."""
        self.stop_reason: str | None = None
        self.best: dict[str, Tensor] = _copy_weights(self.trainer.network) if recipe.guards else {}
        self.course = Course(
            recipe.until_flat, recipe.minutes, self.trainer, least=recipe.least_steps(), cost=recipe.decay_cost
        )
        self._check_together()
        self._table = LossesFile(recipe.out, recipe.counter)
        self.watchers: list[Watcher] = [self._table, EventFiles(recipe.out), *watchers] if group.leads else []
        if recipe.resume:
            self._load(warn)
            progress(f"resumed at {recipe.counter} {self.trainer.step}")
        if group.leads:
            recipe.out.mkdir(parents=True, exist_ok=True)
            self._table.cut(self.trainer.step, self.curve)

    @property
    def finished(self) -> bool:
        """At the end of the recipe, or where its guard has stopped it."""
        return self.stop_reason is not None or self.trainer.step >= self.trainer.steps

    @property
    def evaluation_due(self) -> bool:
        """Whether the weights as they are have still to be measured: every so many steps and at the end, and, where the
        best are kept, before the first step."""
        if self.recipe.guards and not self.curve:
            return True
        step, measured = self.trainer.step, self.curve[-1][self.recipe.counter] if self.curve else 0
        due = step >= self.trainer.steps or step % self.recipe.validation_steps == 0
        return due and step > measured and self.stop_reason is None

    def go(self) -> None:
        """To the end of the run. Ctrl-C or SIGTERM waits for the step under way, breaks a judgement off, saves a
        checkpoint and goes on as KeyboardInterrupt; sent again after a second, it does not wait for the step, and the
        last checkpoint is the one before.
        """
        if self.group.size > 1:
            self._train_in(self.group)
            return
        with parallel.fork_group(self.recipe.processes, self._train_in) as group:
            self._train_in(group)
        self.group = self.trainer.group = ALONE

    def _train_in(self, group: TrainingGroup) -> None:
        """As one process of a group, of which only the first tells anybody."""
        self.group = group
        self.trainer.join(group)
        if not group.leads:
            self.watchers, self.progress = [], _say_nothing
        recipe = self.recipe
        start = RunStart(
            recipe.kind,
            recipe.counter,
            self.trainer.step,
            self.trainer.steps,
            recipe.validation_steps,
            recipe.format_news,
        )
        try:
            for watcher in self.watchers:
                watcher.begin(start)
            self._loop()
        finally:
            for watcher in self.watchers:
                watcher.end()

    def _loop(self) -> None:
        saved, unsaved = time.monotonic(), False
        with defer_signals() as held:
            if self.trainer.step == 0:  # there is nothing yet that an evaluation could be of use for
                self._stop_if_wanted(held, *self.group.agree(held.wanted is not None))
            while True:
                if self.evaluation_due:
                    self._evaluate(held)
                    unsaved = self.trainer.step > 0
                late = self.group.leads and time.monotonic() - saved > 60 * self.recipe.checkpoint_minutes
                up = self.group.leads and self.course.overdue
                overdue, wanted, up = self.group.agree(late, held.wanted is not None, up)
                if self._decide_end(up):  # a clock does not decide twice at the same step: it is saved at once
                    if self.evaluation_due:
                        self._evaluate(held)
                    overdue = True
                if unsaved and (self.finished or overdue or wanted):
                    self._save_undisturbed(held)
                    saved, unsaved = time.monotonic(), False
                self._stop_if_wanted(held, wanted)
                if self.finished:
                    return
                self.update()
                unsaved = True

    def _decide_end(self, overdue: bool) -> bool:
        """Whether it is decided now when the run ends."""
        end = self.course.decide(self.recipe.find_points(self.curve), overdue=overdue, group=self.group)
        if end is None:
            return False
        self.progress(f"{end.reason}: training ends at {self.recipe.counter} {self.trainer.steps}")
        for watcher in self.watchers:
            watcher.see_end(self.trainer.steps)
        return True

    def _stop_if_wanted(self, held: DeferredSignals, wanted: bool) -> None:
        if wanted:
            held.release()
            raise KeyboardInterrupt  # of a process that another one told

    def update(self) -> None:
        """One step, of which half is of no use."""
        recipe, trainer = self.recipe, self.trainer
        if trainer.step % recipe.report_steps == 0:
            self.losses = []
        self.losses.append(trainer.take_step())
        for watcher in self.watchers:
            watcher.see_step(trainer.step, self.losses[-1])
        if trainer.step >= trainer.steps or trainer.step % recipe.report_steps == 0:
            means = _none_where_not_finite({name: _average_known(self.losses, name) for name in self.losses[-1]})
            for watcher in self.watchers:
                watcher.see_losses(trainer.step, means)
        self.stop_reason = recipe.find_stop_reason(trainer, self.losses)
        if self.stop_reason is not None:
            self.progress(f"{self.stop_reason}: training ends with the best {recipe.kind} seen")

    def judge(self) -> Row:
        """Measure the weights as they are. It may be broken off and begun again: until its end it changes nothing."""
        recipe, trainer = self.recipe, self.trainer
        if not recipe.guards:
            trainer.check_finite()
        row = trainer.validate(self.parts.validation)
        if recipe.guards:
            score = recipe.score(row)
            if score < min((recipe.score(before) for before in self.curve), default=math.inf) or not self.curve:
                self.best = _copy_weights(trainer.network)
            row = {**row, "score": score, **{f"training_{name}": average(self.losses, name) for name in self._watched}}
        return _none_where_not_finite(row)

    def export(self) -> Path:
        """Write the model with its card."""
        recipe, path = self.recipe.tell_end(self.course.end), self.recipe.out / "model.safetensors"
        init = getattr(recipe, "init", None)
        if not self.group.leads:
            return path
        if recipe.guards:
            self.trainer.network.load_state_dict(self.best)
        self.trainer.move("cpu")
        recipe.finish(self.trainer)
        made = recipe.export(self.trainer, self.gathered, self.curve)
        training = {"settings": asdict(recipe.settings), "curve": self.curve, "command": recipe.format_command()}
        card = checkpoints.Card(
            kind=recipe.kind,
            config=recipe.find_shape(self.trainer).as_card(),
            licence=recipe.licence,
            data={**made.data, **describe_origin(init), "trained_on": self.gathered.describe_training()},
            training=training | ({"extended": self.extended} if self.extended else {}) | self.course.as_card(),
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
        tensors = self.trainer.state()
        self.group.do_first(partial(self._write_checkpoint, tensors))

    def _write_checkpoint(self, tensors: dict[str, Tensor]) -> bytes:
        index = {
            **self.pinned,
            **self.course.as_index(),
            "steps": self.recipe.steps if self.trainer.steady else self.trainer.steps,
            "first_steps": self.trainer.first_steps,
            "extended": self.extended,
            "processes": self.recipe.processes,
            "device": self.device,
            "precision": find_precision(self.recipe.settings),
            "licence": self.recipe.licence,
            "curve": self.curve,
            "losses": [_none_where_not_finite(row) for row in self.losses],
        }
        if self.recipe.guards:
            tensors = tensors | {f"best.{name}": value for name, value in self.best.items()}
        else:
            self.trainer.check_finite()
        run_files.write_checkpoint(self.recipe.out, step=self.trainer.step, tensors=tensors, index=index)
        return b""

    @property
    def _watched(self) -> tuple[str, ...]:
        """Losses that there are already."""
        return self.recipe.guards if self.losses else ()

    def _evaluate(self, held: DeferredSignals) -> None:
        """The first process judges, and all add the row to their curves."""
        told = self.group.do_first(partial(self._judge_or_break_off, held))
        if not told:
            if self.trainer.step > 0:
                self._save_undisturbed(held)
            raise KeyboardInterrupt
        row = json.loads(told)
        self.curve.append({self.recipe.counter: self.trainer.step, **row})
        self.course.mark_validation()
        for watcher in self.watchers:
            watcher.see_validation(self.trainer.step, row)

    def _judge_or_break_off(self, held: DeferredSignals) -> bytes:
        """The row; nothing where a signal breaks it off."""
        try:
            with held.let_through():
                return json.dumps(self.judge()).encode()
        except KeyboardInterrupt:
            return b""

    def _save_undisturbed(self, held: DeferredSignals) -> None:
        with held.defer_all():
            self.save()

    def _check_together(self) -> None:
        """RequestError where processes on several machines have read other clips."""
        own = json.dumps(self.pinned, sort_keys=True).encode()
        (differs,) = self.group.agree(self.group.do_first(lambda: own) != own)
        if differs:
            raise RequestError("the processes do not train the same: data and options must be alike on all machines")

    def _load(self, warn: Progress) -> None:
        out, recipe = self.recipe.out, self.recipe
        try:
            index, tensors = run_files.share_checkpoint(out, self.group)
            for part, now in self.pinned.items():
                run_files.check_unchanged(out, part, then=index[part], now=now)
            self.curve = run_files.parse_curve(index, recipe.counter)
            self.losses = run_files.parse_losses(index, recipe.guards)
            if recipe.guards:
                self.best = {name: tensors[f"best.{name}"] for name in self.best}
            self._extend(index)
            self.course.load(out, index)
            self.trainer.load_state(tensors, int(index["step"]))
            before = run_files.parse_processes(out, index)
            device, precision = str(index.get("device", "cpu")), index.get("precision")
        except run_files.UNREADABLE_ERRORS as error:
            raise run_files.make_unreadable_error(out, error) from error
        if before != recipe.processes:
            warn(
                f"{out} was trained in {before} processes and goes on in {recipe.processes}:"
                " the result is as good, but not the same to the bit"
            )
        for how, then, now in (("on", device, self.device), ("in", precision, find_precision(recipe.settings))):
            if then not in (now, None):
                warn(f"{out} was trained {how} {then} and goes on {how} {now}: the result is as good, but another one")

    def _extend(self, index: dict[str, Any]) -> None:
        """Take what the checkpoint says of the number of steps; RequestError where more are done than are wanted."""
        recipe, done = self.recipe, int(index["step"])
        before = int(index.get("steps") or index["settings"][recipe.steps_name])
        self.extended = [dict(row) for row in index.get("extended", [])]
        self.trainer.set_first_steps(int(index.get("first_steps", before)))
        if recipe.until_flat is not None:
            if recipe.steps != before:
                raise RequestError(f"{recipe.out}: a run until its curve is flat keeps its --steps {before}")
            return
        if recipe.steps < done:
            raise RequestError(
                f"{recipe.out}: {done} {recipe.counter}s are done; --steps must be at least that, got {recipe.steps}"
            )
        if recipe.steps != before:
            self.extended.append({"at": done, "from": before, "to": recipe.steps})
            self.progress(f"{recipe.steps} {recipe.counter}s in all instead of {before}")


def _copy_weights(network: nn.Module) -> dict[str, Tensor]:
    return {name: value.clone() for name, value in network.state_dict().items()}


def _none_where_not_finite(row: Row) -> Row:
    return {name: value if math.isfinite(value) else None for name, value in row.items()}


def _average_known(rows: Sequence[Row], name: str) -> float:
    return average([row for row in rows if name in row], name)
