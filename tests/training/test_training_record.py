"""What a run tells: losses.csv, lines and the live table, TensorBoard's files, and plots."""

import importlib.util
import io
import json
import subprocess
import sys
from dataclasses import replace

import pytest
from helpers import killing
from helpers import run as mapctl_run
from rich.console import Console
from tiny_infiller import CONFIG as INFILLER

from mapctl.commands.train.progress import LiveTable
from mapctl.errors import RequestError, WriteError
from priors.training.recipes.infiller import InfillerRecipe, InfillerSettings, InfillerTrainer
from priors.training.record import losses_file
from priors.training.record.losses_file import LossesFile, LossRow, read_losses
from priors.training.record.watching import LineWatcher, Pace, RunStart, Watcher, format_duration
from priors.training.run import train
from scenes.plots.training import Curve, plot_curves


def wanted(data, out, **changes):
    settings = InfillerSettings(steps=6, batch=2, window=40)
    given = {"validate_steps": 2, "report_steps": 3, "checkpoint_minutes": 0.0}
    return InfillerRecipe(data, out, config=INFILLER, settings=settings, **given | changes)


def start(**changes):
    told = {"step": 0, "steps": 10, "validate_steps": 5, "format_news": lambda rows: f"{len(rows)} rows"}
    return RunStart("infiller", "step", **told | changes)


class Clock:
    """Time that goes on as it is told."""

    now = 0.0

    def __call__(self):
        return self.now


class Noted(Watcher):
    """Keeps what it is told."""

    def __init__(self):
        self.steps, self.means, self.validations, self.ended = [], {}, {}, 0

    def see_step(self, step, losses):
        self.steps.append((step, losses))

    def see_losses(self, step, means):
        self.means[step] = means

    def see_validation(self, step, measures):
        self.validations[step] = measures

    def end(self):
        self.ended += 1


@pytest.mark.slow
def test_the_table_of_losses_is_what_was_told(tmp_path, data):
    noted = Noted()
    train(wanted(data, tmp_path / "run"), watchers=[noted])
    rows = read_losses(tmp_path / "run" / "losses.csv")
    assert [(row.step, row.part) for row in rows] == [
        (2, "validation"),
        (3, "training"),
        (4, "validation"),
        (6, "training"),
        (6, "validation"),
    ]
    told = [losses["loss"] for step, losses in noted.steps if 4 <= step <= 6]
    assert rows[3].values["loss"] == pytest.approx(sum(told) / 3, rel=1e-8)
    assert rows[3].values == {name: pytest.approx(value, rel=1e-8) for name, value in noted.means[6].items()}
    assert rows[4].values == {name: pytest.approx(value, rel=1e-8) for name, value in noted.validations[6].items()}
    card = json.loads((tmp_path / "run" / "model.json").read_text())
    assert rows[4].values["error_15_cm"] == pytest.approx(card["training"]["curve"][-1]["error_15_cm"])
    assert [step for step, _ in noted.steps] == [1, 2, 3, 4, 5, 6]
    assert noted.ended == 1


@pytest.mark.slow
def test_rows_beyond_the_checkpoint_are_cut_and_come_again(tmp_path, data):
    train(wanted(data, tmp_path / "whole"))
    with killing(InfillerTrainer, 5):
        train(wanted(data, tmp_path / "parts"))
    file = tmp_path / "parts" / "losses.csv"
    head, *rows = file.read_text().splitlines()
    empty = "," * (head.count(",") - 1)
    file.write_text("\n".join([head, *rows, "6,training" + empty[:-1] + "9", "6,validation" + empty, "7,tr"]))
    train(wanted(data, tmp_path / "parts", resume=True))
    assert file.read_bytes() == (tmp_path / "whole" / "losses.csv").read_bytes()


@pytest.mark.slow
@pytest.mark.parametrize("damage", [None, b"", b"\xff\xfe\x00", b"step,part,loss\n1,2,3\nx,training,1\n", b"no\n"])
def test_a_table_that_is_gone_or_damaged_begins_with_the_curve(tmp_path, data, damage):
    with killing(InfillerTrainer, 5):
        train(wanted(data, tmp_path / "run"))
    file = tmp_path / "run" / "losses.csv"
    file.unlink() if damage is None else file.write_bytes(damage)
    train(wanted(data, tmp_path / "run", resume=True))
    rows = read_losses(file)
    assert [row.step for row in rows if row.part == "validation"] == [2, 4, 6]
    assert [row.step for row in rows if row.part == "training"] == [6]


def test_columns_come_in_at_their_first_row_and_what_is_not_finite_is_left_empty(tmp_path):
    table = LossesFile(tmp_path, "round")
    table.cut(0, [])
    table.see_validation(0, {"score": 2.0, "empty": None})
    table.see_losses(5, {"loss": 0.1, "bad": None})
    table.see_losses(10, {"loss": float("nan"), "extra": 3})
    table.see_validation(10, {"loss": 4.0})
    assert (tmp_path / "losses.csv").read_text().splitlines() == [
        "round,part,loss,extra,score",
        "0,validation,,,2",
        "5,training,0.1,,",
        "10,training,,3,",
        "10,validation,4,,",
    ]
    assert read_losses(tmp_path / "losses.csv")[-1] == LossRow(10, "validation", {"loss": 4.0})


def test_columns_have_one_order_however_often_the_table_is_begun_anew(tmp_path):
    table = LossesFile(tmp_path, "step")
    table.cut(0, [])
    table.see_validation(2, {"pairs": 3, "off": 1.0})
    table.see_losses(3, {"off": 2.0})
    whole = (tmp_path / "losses.csv").read_text()
    assert whole.startswith("step,part,off,pairs\n")
    again = LossesFile(tmp_path, "step")
    again.cut(2, [{"step": 2, "pairs": 3, "off": 1.0}])
    again.see_losses(3, {"off": 2.0})
    assert (tmp_path / "losses.csv").read_text() == whole


def test_a_table_that_cannot_be_written_is_told_in_one_line(tmp_path):
    table = LossesFile(tmp_path, "step")
    table.cut(0, [])
    table.see_losses(1, {"loss": 1.0})
    (tmp_path / "losses.csv").unlink()
    (tmp_path / "losses.csv").mkdir()
    with pytest.raises(WriteError, match=r"cannot write .*losses.csv"):
        table.see_losses(2, {"loss": 1.0})


def test_the_pace_counts_validations_that_are_to_come():
    clock = Clock()
    pace = Pace(clock)
    assert pace.rate is pace.find_remaining(3, 1) is None
    for _ in range(4):
        clock.now += 0.5
        pace.mark_step()
    clock.now += 10
    pace.mark_validation()
    assert pace.rate == pytest.approx(2.0)
    assert pace.find_remaining(6, 2) == pytest.approx(3 + 20)
    assert pace.elapsed == 12
    assert [format_duration(seconds) for seconds in (0.4, 65, 3661)] == ["0:00:00", "0:01:05", "1:01:01"]


def test_a_log_has_a_line_soon_then_now_and_then_and_at_the_end():
    clock, lines = Clock(), []
    watcher = LineWatcher(lines.append, log=True, clock=clock)
    watcher.begin(start(steps=60, step=10, validate_steps=100))
    for step in range(11, 61):
        clock.now += 2
        watcher.see_step(step, {"loss": 1.0})
        watcher.see_losses(step, {"loss": 1.0})
    watcher.see_validation(60, {"error_cm": 1.23456, "bad": None})
    assert [line.split(":")[0] for line in lines] == [
        "step 13/60",
        "step 28/60",
        "step 43/60",
        "step 58/60",
        "step 60/60",
        "validation at step 60",
    ]
    assert lines[1] == "step 28/60: 15 rows, 2.0 s a step, 0:01:04 left"
    assert lines[-1].endswith("error_cm 1.235, bad -")


def test_the_live_table_shows_total_rate_remaining_time_losses_and_validations():
    shown = io.StringIO()
    console = Console(file=shown, width=110, force_terminal=True, color_system=None)
    with LiveTable(console) as table:
        table.begin(start())
        table.see_step(1, {"loss": 4.0, "rare": float("nan")})
        table.see_step(2, {"loss": 2.0, "rare": 7.0})
        for step in (2, 4, 6, 8):
            table.see_validation(step, {"error_cm": 1.5 + step})
        drawn = Console(file=io.StringIO(), width=110)
        drawn.print(table.render())
    text = drawn.file.getvalue()
    assert "2/10 steps (20.0 %)" in text
    assert "left" in text
    rows = [line.split() for line in text.splitlines()]
    assert any(row[:3] == ["loss", "4", "3"] for row in rows)
    assert any(row[:3] == ["rare", "-", "7"] for row in rows)
    assert any(row[-4:] == ["error_cm", "3.5", "7.5", "9.5"] or row[-3:] == ["3.5", "7.5", "9.5"] for row in rows)
    assert "2/10 steps" in shown.getvalue()


@pytest.mark.slow
def test_in_a_pipe_there_are_lines_and_quiet_says_nothing(tmp_path, data, capsys):
    words = ("train", "infiller", "--data", data, "--steps", 2, "--batch", 2, "--window", 40)
    assert mapctl_run(*words, "-o", tmp_path / "run") == 0
    told = capsys.readouterr().out
    assert "step 2/2: loss " in told
    assert "validation at step 2: error_15_cm" in told
    assert "\x1b" not in told
    assert mapctl_run(*words, "-o", tmp_path / "other", "--quiet") == 0
    assert capsys.readouterr() == ("", "")
    assert (tmp_path / "other" / "losses.csv").read_bytes() == (tmp_path / "run" / "losses.csv").read_bytes()


@pytest.mark.slow
def test_a_plot_is_renewed_at_each_validation(tmp_path, data, capsys, monkeypatch):
    from mapctl.commands.train import curves as training_curves

    drawn = []
    monkeypatch.setattr(training_curves, "plot_curves", lambda curves, path, **told: drawn.append((curves, path, told)))
    train(wanted(data, tmp_path / "run"), watchers=[training_curves.CurvePlotter(tmp_path / "run" / "curves.png")])
    assert [len(curves[0].steps) for curves, _, _ in drawn] == [1, 2, 3]
    curves = {(curve.name, curve.training): curve for curve in drawn[-1][0]}
    assert curves["loss", True].steps == (3, 6)
    assert curves["error_15_cm", False].steps == (2, 4, 6)
    assert drawn[-1][2]["counter"] == "step"


@pytest.mark.slow
def test_a_run_and_a_prior_are_drawn_and_what_holds_no_losses_is_one_line(tmp_path, data, capsys, prior):
    words = ("train", "infiller", "--data", data, "--steps", 2, "--batch", 2, "--window", 40, "--quiet", "--plot")
    assert mapctl_run(*words, "-o", tmp_path / "run") == 0
    assert (tmp_path / "run" / "curves.png").read_bytes()[:4] == b"\x89PNG"
    assert mapctl_run("info", tmp_path / "run", "-o", tmp_path / "run.png") == 0
    assert "run.png (10 curves)" in capsys.readouterr().out
    (tmp_path / "run" / "losses.csv").unlink()  # a run of an older version
    assert mapctl_run("info", tmp_path / "run", "-o", tmp_path / "old.png") == 0
    assert "old.png (4 curves)" in capsys.readouterr().out
    assert mapctl_run("info", "locomotion", "-o", tmp_path / "prior.png") == 0
    assert "prior.png (6 curves)" in capsys.readouterr().out
    (tmp_path / "empty").mkdir()
    refused = {
        tmp_path / "empty": "holds no losses to draw",
        tmp_path / "nowhere": "nowhere",
        prior: "holds no training curve to draw",
    }
    for name, message in refused.items():
        assert mapctl_run("info", name, "-o", tmp_path / "no.png") == 2
        told = capsys.readouterr().err
        assert message in told
        assert told.count("\n") == 1
    assert mapctl_run("info", tmp_path / "run", "-o", tmp_path / "no.jpg") == 2
    assert ".png" in capsys.readouterr().err
    assert not (tmp_path / "no.png").exists()


@pytest.mark.slow
def test_curves_of_all_sorts_are_drawn(tmp_path):
    curves = [
        Curve("loss", True, tuple(range(100)), tuple(1000.0 / (1 + step) for step in range(100))),
        Curve("loss", False, (50,), (20.0,)),
        *(Curve(f"measure_{number}", False, (0, 9), (-1.0, 1.0)) for number in range(6)),
    ]
    plot_curves(curves, tmp_path / "curves.png", counter="round", title="a run")
    assert (tmp_path / "curves.png").stat().st_size > 10_000
    with pytest.raises(RequestError, match="no losses to draw"):
        plot_curves([], tmp_path / "none.png", counter="step", title="a run")


def test_without_matplotlib_a_plot_is_refused_before_training(tmp_path, data, capsys, monkeypatch):
    from mapctl.commands.shared import outputs

    monkeypatch.setattr(outputs, "find_spec", lambda name: None)
    assert mapctl_run("train", "infiller", "--data", data, "-o", tmp_path / "run", "--plot") == 2
    assert "matplotlib" in capsys.readouterr().err
    assert not (tmp_path / "run").exists()


@pytest.mark.slow
def test_tensorboard_is_not_imported_where_it_is_not_installed(tmp_path, data, monkeypatch):
    from priors.training.record import event_files

    monkeypatch.setattr(event_files, "find_spec", lambda name: None)
    monkeypatch.setitem(sys.modules, "torch.utils.tensorboard.writer", None)  # an import would fail
    train(wanted(data, tmp_path / "run"))
    assert not (tmp_path / "run" / "tensorboard").exists()


@pytest.mark.skipif(importlib.util.find_spec("tensorboard") is None, reason="TensorBoard is an extra")
def test_tensorboard_reads_what_the_table_holds(tmp_path, data):
    """In a process of its own: what that package warns of is not ours."""
    train_script = (
        "import sys; from pathlib import Path; from dataclasses import replace; sys.path.insert(0, 'tests')\n"
        "from training.test_training_record import wanted, train, killing, InfillerTrainer\n"
        "run = wanted(Path(sys.argv[1]), Path(sys.argv[2]))\n"
        "with killing(InfillerTrainer, 5): train(run)\n"
        "train(replace(run, resume=True))\n"
        "from tensorboard.backend.event_processing.event_accumulator import EventAccumulator\n"
        "found = EventAccumulator(sys.argv[2] + '/tensorboard'); found.Reload()\n"
        "print([(p.step, p.value) for p in found.Scalars('validation/error_15_cm')])\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", train_script, str(data), str(tmp_path / "run")], capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    rows = [row for row in read_losses(tmp_path / "run" / "losses.csv") if row.part == losses_file.VALIDATION]
    points = eval(done.stdout)
    assert [step for step, _ in points] == [row.step for row in rows] == [2, 4, 6]
    assert [value for _, value in points] == pytest.approx([row.values["error_15_cm"] for row in rows], rel=1e-6)


@pytest.mark.slow
def test_watchers_end_also_where_training_fails(tmp_path, data):
    noted = Noted()
    with killing(InfillerTrainer, 3):
        train(wanted(data, tmp_path / "run"), watchers=[noted])
    assert noted.ended == 1
    train(replace(wanted(data, tmp_path / "run"), resume=True), watchers=[noted])
    assert [step for step, _ in noted.steps] == [1, 2, 3, 4, 5, 6]
