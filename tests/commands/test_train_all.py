"""`mapctl train all`: order, what is skipped, ends and limits, what is refused; and two sets beside each other."""

import json
import shlex
import signal
import subprocess
import sys
import time
from pathlib import Path
from threading import Thread

import pytest
import torch
from helpers import run

from mapctl import cli
from mapctl.commands.train.whole_set import TrainAll, summary, workers
from mapctl.commands.train.whole_set.plan import lock_folder
from priors import checkpoints
from priors.checkpoints import Card
from priors.training.bundled.models import SETS, list_models

PLOT_SET = summary.plot_set
NAMES = [model.name for model in list_models()]


def save_model(folder: Path, kind: str, command: str, *, error: float = 1.0, size: int = 4, held_out=("a",)) -> None:
    """A finished model with the card of its kind."""
    test = {"loss": error, "half_off_by": error, "all_V1_cm": error, "share_10_5": error, "bare_5": error}
    test |= {"walk_error_cm": error, "walk_slerp_cm": 1.0}
    quality = {"test": test, "test_nats_per_frame": -100.0 * error}
    if kind == "refiner":
        quality = {"jitter_m_s3_ratio": 1.0, "told_apart": 0.5 + error / 10}
    words = shlex.split(command)
    used = {name: words[words.index(f"--{name}") + 1] for name in ("density", "stitcher") if f"--{name}" in words}
    training = {
        "command": command,
        "settings": {"steps": 24},
        "curve": [{"step": step, "round": step, "validation_nats": 1.0 - step, **test} for step in (8, 16, 24)],
        "ended": {"steps": 24, "decay_from": 20, "reason": "the curve was flat", "minutes": 1.5},
    }
    data = {"density": "", **used, "held_out": {"test": list(held_out)}}
    shared = {"data": data, "training": training, "quality": quality, **Card.layout_fields()}
    card = Card(kind, {}, licence="none", **shared)
    folder.mkdir(parents=True, exist_ok=True)
    checkpoints.save({"weights": torch.zeros(size)}, card, folder / "model.safetensors")


class Stage:
    """What stand-ins for training processes have done, and are to do."""

    def __init__(self):
        self.events: list[tuple[str, str]] = []
        self.words: dict[str, list[str]] = {}
        self.failing: dict[str, str] = {}
        self.interrupting: str | None = None
        self.errors: dict[str, float] = {}
        self.most = self.live = 0
        self.stopped: list[str] = []


@pytest.fixture
def stage(monkeypatch):
    """Models are saved by threads instead of trained by processes."""
    made = Stage()

    class Standing(workers.Worker):
        status = None

        def __init__(self, name, words, *, lock, say, ended):
            if name == made.interrupting:
                made.interrupting = None
                raise KeyboardInterrupt
            given = cli.parse(words[1:])
            self.name, self.last, self.out = name, "", given.out
            made.words[name] = list(words)
            made.events.append(("begin", name))
            made.live += 1
            made.most = max(made.most, made.live)
            self._thread = Thread(target=self._train, args=(given, say, ended))
            self._thread.start()

        def _train(self, given, say, ended):
            time.sleep(0.1 if self.name in ("locomotion", "path") else 0.01)  # others wait for these
            made.live -= 1
            made.events.append(("end", self.name))
            try:
                self._finish(given, say)
            finally:
                ended(self.name)

        def _finish(self, given, say):
            self.status = 2
            if self.name in made.failing:
                self.last = f"mapctl: {made.failing[self.name]}"
                say(self.name, self.last)
                return
            say(self.name, "step 24/24")
            command = given.recipe().format_command()
            save_model(self.out, given.model, command, error=made.errors.get(self.name, 1.0))
            self.status = 0

        def stop(self):
            made.stopped.append(self.name)

        def wait(self):
            self._thread.join()

    monkeypatch.setattr(workers, "Worker", Standing)
    monkeypatch.setattr(summary, "plot_set", lambda folder, path: False)  # a second each time
    return made


@pytest.fixture
def train_all(tmp_path, data):
    """Types it with more words."""

    def typed(*words, out="set", clips=data):
        return run("train", "all", "--data", clips, "-o", tmp_path / out, *words)

    return typed


def test_all_are_trained_each_after_what_it_needs(tmp_path, stage, train_all, capsys, monkeypatch):
    monkeypatch.setattr(summary, "plot_set", PLOT_SET)
    assert train_all("--jobs", 3) == 0
    told = capsys.readouterr()
    assert [name for what, name in stage.events if what == "begin"][:3] == NAMES[:3]
    for first, then in (("locomotion", "locomotion-refiner"), ("path", "tweener")):
        assert stage.events.index(("end", first)) < stage.events.index(("begin", then))
    assert stage.most <= 3
    assert {file.name for file in (tmp_path / "set" / "weights").iterdir()} == {
        f"{name}.{ending}" for name in NAMES for ending in ("safetensors", "json")
    }
    for model in list_models():
        card = checkpoints.read_card(tmp_path / "set" / "weights" / f"{model.name}.json")
        assert card.training["command"] == model.command
    assert "10 models, " in told.out
    assert " MB of 64 MB\n" in told.out
    assert (tmp_path / "set" / "curves.png").read_bytes().startswith(b"\x89PNG")
    assert "path: step 24/24" in told.out


def test_a_run_whose_steps_are_told_has_no_limit_in_minutes(stage, train_all):
    assert train_all("--only", "locomotion,path", "--weights", "free") == 0
    assert "--minutes" not in stage.words["locomotion"]
    assert "--minutes" in stage.words["path"]


def test_one_at_a_time_they_come_in_the_order_of_the_table(stage, train_all):
    assert train_all() == 0
    assert [name for what, name in stage.events if what == "begin"] == NAMES
    assert stage.most == 1


def test_each_is_trained_by_the_command_of_the_table_with_folders_in_it(tmp_path, data, stage, train_all):
    assert train_all("--only", "path, tweener", "--minutes", 30) == 0
    out = tmp_path / "set"
    assert stage.words["path"] == shlex.split(
        f"mapctl train path --data {data} -o {out / 'path'} --cuts cmu --until-flat"
        " --licence 'that of the training data' --minutes 30"
    )
    assert stage.words["tweener"] == shlex.split(
        f"mapctl train tweener --data {data} -o {out / 'tweener'} --cuts cmu --until-flat"
        f" --path {out / 'path'} --licence 'that of the training data' --minutes 30"
    )
    assert (out / "path" / "cache").resolve() == (out / "tweener" / "cache").resolve() == out / "cache"


def test_what_is_finished_is_skipped_and_what_is_not_goes_on(tmp_path, stage, train_all, capsys):
    assert train_all("--only", "path,denoiser") == 0
    (tmp_path / "set" / "denoiser" / "model.json").unlink()
    (tmp_path / "set" / "denoiser" / "checkpoint.json").write_text("{}")
    stage.events.clear()
    assert train_all("--only", "path,denoiser,keyframe-timing") == 0
    assert [name for what, name in stage.events if what == "begin"] == ["denoiser", "keyframe-timing"]
    assert stage.words["denoiser"][-1] == "--resume"
    assert "--resume" not in stage.words["keyframe-timing"]
    assert "path: is finished" in capsys.readouterr().out


def test_interrupted_it_says_what_to_type_and_that_goes_on(tmp_path, data, stage, train_all, capsys):
    stage.interrupting = "stitcher"
    assert train_all("--jobs", 2, "--match", "walk", out="my set") == 130
    told = capsys.readouterr().err
    begin, _, typed = told.partition("go on with: ")
    assert begin in [f"mapctl: interrupted; {count} of 10 models are finished; " for count in (0, 1, 2)]
    assert set(stage.stopped) <= {"locomotion", "locomotion-live"}
    words = shlex.split(typed)
    assert words == [
        *("mapctl", "train", "all", "--data", str(data), "--out", str(tmp_path / "my set")),
        *("--match", "walk", "--jobs", "2"),
    ]
    assert run(*words[1:]) == 0
    assert len(list((tmp_path / "my set" / "weights").glob("*.json"))) == 10


def test_every_option_is_in_the_line():
    words = ["train", "all", "--data", "d", "-o", "o", "--weights", "free", "--only", "path", "--seed", "2", "--quiet"]
    given = cli.parse([*words, "--minutes", "5", "--jobs", "2", "--match=-x"])
    assert isinstance(given, TrainAll)
    assert cli.parse(given.format_command()[1:]) == given


@pytest.mark.slow
def test_one_that_fails_ends_only_those_that_need_it(tmp_path, stage, train_all, capsys):
    stage.failing["locomotion"] = "no .bvh below clips matches 'dataset-2'"
    assert train_all() == 2
    told = capsys.readouterr()
    assert told.err == (
        "mapctl: locomotion: no .bvh below clips matches 'dataset-2'\n"
        "mapctl: 2 of 10 models are not finished: locomotion: no .bvh below clips matches 'dataset-2';"
        " locomotion-refiner: needs locomotion\n"
    )
    assert len(list((tmp_path / "set" / "weights").glob("*.json"))) == 8
    stage.failing.clear()
    stage.events.clear()
    assert train_all("--quiet") == 0
    assert [name for what, name in stage.events if what == "begin"] == ["locomotion", "locomotion-refiner"]
    assert "step" not in capsys.readouterr().out.replace("steps", "")


@pytest.mark.slow
def test_a_second_seed_and_both_sets_beside_each_other(tmp_path, stage, train_all, capsys):
    assert train_all() == 0
    stage.errors = {"path": 1.03, "denoiser": 1.2, "locomotion": 1.01}
    assert train_all("--seed", 2, out="other") == 0
    assert "--seed 2 --split-seed 1" in " ".join(stage.words["path"])
    assert "--seed 2" in " ".join(stage.words["locomotion-refiner"])
    capsys.readouterr()
    sets = (tmp_path / "set", tmp_path / "other")
    assert run("train", "all", "--compare", *sets) == 3
    rows = {line.split()[0]: line.split() for line in capsys.readouterr().out.splitlines() if line.split()}
    assert rows["path"][1:3] == ["1", "1.03"]
    assert float(rows["path"][-2]) == pytest.approx(3.0)
    assert float(rows["locomotion"][-2]) == pytest.approx(-1.5, abs=0.2)  # a nat of a hundred, by 66 numbers
    assert rows["tweener"][-2:] == ["0", "same"]
    assert "denoiser" in " ".join(rows["more"])
    assert "path" not in " ".join(rows["more"])
    assert run("train", "all", "--compare", *sets, "--within", 25) == 0


def test_a_set_is_checked(tmp_path, stage, train_all, capsys, monkeypatch):
    assert train_all("--only", "path,denoiser") == 0
    capsys.readouterr()
    assert run("train", "all", "--check", tmp_path / "set") == 3
    told = capsys.readouterr().out
    assert "2 models, " in told
    assert "not there: general, keyframe-timing, locomotion" in told
    assert "the curve was flat" in told
    save_model(tmp_path / "set" / "large", "path", "", size=16_100_000)
    (tmp_path / "set" / "large" / "model.safetensors").rename(tmp_path / "set" / "weights" / "large.safetensors")
    (tmp_path / "set" / "large" / "model.json").rename(tmp_path / "set" / "weights" / "large.json")
    for name in NAMES:
        for ending in ("json", "safetensors"):
            file = tmp_path / "set" / "weights" / f"{name}.{ending}"
            file.exists() or file.write_bytes((tmp_path / "set" / "weights" / f"path.{ending}").read_bytes())
    assert run("train", "all", "--check", tmp_path / "set" / "weights") == 0
    with (tmp_path / "set" / "weights" / "large.safetensors").open("ab") as file:
        file.truncate(64_000_000)
    assert run("train", "all", "--check", tmp_path / "set") == 3
    assert " MB of 64 MB, 0.0 MB too much" in capsys.readouterr().out


def test_the_bundled_set_is_checked_too(capsys):
    assert run("train", "all", "--check", Path(checkpoints.__file__).parent / "weights") == 0
    assert "10 models, " in capsys.readouterr().out


def test_the_commands_are_printed(capsys):
    assert run("train", "all", "--commands", "--only", "path", "--weights", "free") == 0
    assert capsys.readouterr().out == (
        f"path: mapctl train path --data DATA -o RUN --match '{SETS['free'].match}'"
        " --level --cuts cmu --steps 4800 --until-flat\n"
    )


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--only", "walker"), "--only is of locomotion, locomotion-live,"),
        (("--only", "tweener"), "tweener needs path, which is not in new: add it to --only"),
        (("--jobs", "0"), "--jobs must be at least 1"),
        (("--minutes", "0"), "--minutes must be positive"),
        (("--minutes", "nan"), "--minutes must be positive"),
        (("--seed", "-3"), "the seed must be"),
        (("--weights", "cheap"), "invalid choice 'cheap'"),
        (("--data", "nowhere"), "nowhere is not a folder of BVH files"),
        (("--data", "empty"), "no .bvh below empty"),
        (("-o", "foreign"), "foreign is not empty, and was not begun by mapctl train all"),
        (("--compare", "empty"), "--compare"),
        (("--check", "empty", "--commands"), "asked for one at a time"),
        (("--check", "empty"), "--check and --compare print and write nothing: leave out -o"),
        (("--compare", "one", "other"), "leave out -o"),
    ],
    ids=lambda value: "-".join(value) if isinstance(value, tuple) else "",
)
def test_what_cannot_be_is_refused_in_one_line(fails, tmp_path, data, words, message):
    (tmp_path / "empty").mkdir()
    (tmp_path / "foreign").mkdir()
    (tmp_path / "foreign" / "notes.txt").write_text("mine")
    assert message in fails("train", "all", "--data", data, "-o", "new", *words)


def test_folders_are_asked_for(fails):
    assert "train all needs --data DATA and -o OUT" in fails("train", "all")


def test_another_recipe_other_clips_and_other_runs_are_refused(tmp_path, data, stage, train_all, capsys):
    assert train_all("--only", "locomotion,path,tweener", "--match", "walk") == 0
    capsys.readouterr()
    out = tmp_path / "set"

    def refused(*words, **where):
        assert train_all(*words, **where) == 2
        told = capsys.readouterr().err
        assert told.count("\n") == 1
        return told

    told = refused("--only", "locomotion", "--match", "walk-[01]")
    assert f"{out / 'locomotion'} was begun as: mapctl train lstm-gmm" in told
    assert "delete" in told
    assert "was begun as" in refused("--only", "path", "--seed", 2)
    (tmp_path / "more").mkdir()
    (tmp_path / "more" / "one.bvh").write_bytes((data / "walk-0.bvh").read_bytes())
    assert "was begun with other clips" in refused("--only", "path", clips=tmp_path / "more")
    save_model(out / "path", "path", "", size=5)
    assert f"{out / 'tweener'} was trained with another path" in refused("--only", "path,tweener")
    save_model(out / "denoiser", "denoiser", "")
    assert "holds a run that mapctl train all did not begin" in refused("--only", "denoiser")
    (out / "all.json").write_text("[]")
    assert "all.json cannot be read" in refused("--only", "path")


def test_only_one_trains_in_a_folder(tmp_path, stage, train_all, capsys):
    with lock_folder(tmp_path / "set"):
        (tmp_path / "set" / ".lock").unlink()  # a folder that holds nothing yet
        (tmp_path / "set").rmdir()
        assert train_all("--only", "path") == 0
    with lock_folder(tmp_path / "set"):
        assert train_all("--only", "denoiser") == 2
    assert "is being trained in by another process" in capsys.readouterr().err


TINY = ("--only", "path,keyframe-timing", "--minutes", "0.02")


@pytest.mark.slow
def test_processes_train_and_the_set_is_there(tmp_path, train_all, capsys):
    """As typed: models end where their minutes are up, by the commands that their cards name."""
    assert train_all(*TINY, "--jobs", 2) == 0
    told = capsys.readouterr().out
    card = checkpoints.read_card(tmp_path / "set" / "weights" / "path.json")
    assert "0.02 minutes were nearly up" in told
    assert card.training["command"].startswith("mapctl train path --data DATA -o RUN --cuts cmu --until-flat --decay-")
    assert card.licence == "that of the training data"
    assert 0 < card.training["ended"]["minutes"] < 0.2
    log = (tmp_path / "set" / "path" / "losses.csv").read_text()
    assert log.startswith("step,part,")


@pytest.mark.slow
def test_what_a_process_has_against_its_data_is_told(tmp_path, data, train_all, capsys):
    (tmp_path / "few").mkdir()
    text = (data / "walk-0.bvh").read_text().splitlines()
    at = next(number for number, line in enumerate(text) if line.startswith("Frames:"))
    (tmp_path / "few" / "short.bvh").write_text("\n".join([*text[:at], "Frames: 4", *text[at + 1 : at + 6]]) + "\n")
    assert train_all("--only", "keyframe-timing", clips=tmp_path / "few") == 2
    told = capsys.readouterr().err
    assert told.startswith("mapctl: keyframe-timing: training needs ")
    assert "1 of 1 models are not finished: keyframe-timing: training needs" in told


@pytest.mark.slow  # two processes are ended
def test_a_signal_ends_the_processes_with_their_checkpoints(tmp_path, data):
    words = ["--data", str(data), "-o", str(tmp_path / "set"), "--only", "path,denoiser", "--jobs", "2"]
    begun = [sys.executable, "-m", "mapctl", "train", "all", *words]
    with subprocess.Popen(begun, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        seen: set[str] = set()
        while seen != {"path", "denoiser"}:
            line = process.stdout.readline()
            assert line
            seen |= {line.split(":")[0]} if ": step " in line else set()
        process.send_signal(signal.SIGINT)
        _, told = process.communicate(timeout=120)
    assert process.returncode == 130
    assert "mapctl: interrupted; 0 of 2 models are finished; go on with: mapctl train all --data" in told
    for name in ("path", "denoiser"):
        index = json.loads((tmp_path / "set" / name / "checkpoint.json").read_text())
        assert index["step"] > 0
        assert index["seconds"] > 0
        (tmp_path / "set" / name / "model.json").exists()
    assert run("train", "all", *words, "--minutes", 0.01) == 0
    for name in ("path", "denoiser"):
        ended = checkpoints.read_card(tmp_path / "set" / "weights" / f"{name}.json").training["ended"]
        assert ended["steps"] > 0
