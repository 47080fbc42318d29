"""Training that is ended early, of every model: what is saved goes on to the bit, and one line says how."""

import json
import os
import re
import shlex
import signal
import subprocess
import sys
from dataclasses import replace
from functools import partial

import pytest
from ended_models import MODELS, VARIANTS, list_params
from helpers import run as mapctl_run
from safetensors import SafetensorError

from mapctl import cli
from mapctl.commands import SUBCOMMANDS
from mapctl.commands.train.options import TrainOptions
from mapctl.commands.train.whole_set import TrainAll
from mapctl.runtime import interruption
from mapctl.runtime.interruption import DeferredSignals
from priors import checkpoints, tensor_files
from priors.training import run, run_files
from priors.training.mocap import clips
from priors.training.recipes import lstm_gmm


def test_whatever_can_be_trained_is_ended_here():
    assert [*MODELS, TrainAll.model] == list(SUBCOMMANDS["train"])  # test_train_all.py ends the whole set


@pytest.fixture(scope="module", params=list_params(MODELS | VARIANTS))
def model(request):
    return (MODELS | VARIANTS)[request.param]


pytestmark = pytest.mark.usefixtures("small_judgements")


@pytest.fixture
def request_in(data, model, prior):
    """Without checkpoints but at the end and where a run is ended."""
    return lambda out, **changes: replace(model.recipe(data, out, prior), **changes)


def send(number=signal.SIGTERM):
    """As from outside; with nothing listening, Python would die of it."""
    os.kill(os.getpid(), number)


@pytest.fixture(autouse=True)
def handlers():
    """Whatever tests install is taken away again."""
    before = {number: signal.getsignal(number) for number in interruption.SIGNALS}
    for number in before:
        signal.signal(number, signal.SIG_DFL)
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


def ended(model, request, *, at, method=None, how=send):
    """Trains until a step or another method of trainer or run is begun at so many steps, then sends a signal.

    Returns the step that is saved, and the last one of the curve.
    """
    interruption.raise_on_signals()
    owner, name = method or (model.trainer, "train_step")
    whole = getattr(owner, name)

    def signalled(self):
        if getattr(self, "trainer", self).step == at:
            how()
        return whole(self)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(owner, name, signalled)
        with pytest.raises(KeyboardInterrupt):
            run.train(request)
    index = json.loads((request.out / "checkpoint.json").read_text())
    return index["step"], index["curve"][-1][request.counter] if index["curve"] else 0


FILES = ("model.safetensors", "model.json", "step-6-checkpoint.safetensors", "checkpoint.json", "losses.csv")


@pytest.fixture(scope="module")
def whole(tmp_path_factory, model, data, prior):
    """The folder of an uninterrupted run, which tests only read."""
    folder = tmp_path_factory.mktemp("whole") / "whole"
    run.train(model.recipe(data, folder, prior))
    return folder


def assert_same(run_folder, other):
    """To the bit, the card with the curve among it, and nothing else left."""
    assert {file.name for file in run_folder.iterdir()} == {*FILES, "cache"}
    for name in FILES:
        assert (run_folder / name).read_bytes() == (other / name).read_bytes(), name


@pytest.mark.slow
def test_ended_in_a_step_it_goes_on_to_the_bit(tmp_path, model, request_in, whole):
    """The step is done to its end. After the second and the last there is a judgement, which is not waited for."""
    request = request_in(tmp_path / "parts")
    assert ended(model, request, at=1) == (2, 0)
    request = replace(request, resume=True)
    assert ended(model, request, at=2, how=partial(send, signal.SIGINT)) == (3, 2)
    assert ended(model, request, at=5, how=partial(send, signal.SIGHUP)) == (6, 4)
    run.train(request)
    assert_same(tmp_path / "parts", whole)


@pytest.mark.slow
def test_ended_in_a_judgement_it_is_judged_again(tmp_path, model, request_in, whole):
    request, judge = request_in(tmp_path / "parts"), (run.TrainingRun, "judge")
    assert ended(model, request, at=4, method=judge) == (4, 2)
    assert ended(model, replace(request, resume=True), at=6, method=judge) == (6, 4)
    run.train(replace(request, resume=True))
    assert_same(tmp_path / "parts", whole)


@pytest.mark.slow
def test_ended_just_after_a_judgement_it_is_not_judged_again(tmp_path, model, request_in, whole):
    request = request_in(tmp_path / "parts")

    def news(line):
        if line.startswith(f"validation at {request.counter} 4:"):
            send()

    interruption.raise_on_signals()
    with pytest.raises(KeyboardInterrupt):
        run.train(request, news)
    run.train(request_in(tmp_path / "parts", resume=True))
    assert_same(tmp_path / "parts", whole)


@pytest.mark.slow
def test_ended_while_it_exports_it_exports_again(tmp_path, model, request_in, whole, monkeypatch):
    interruption.raise_on_signals()
    with monkeypatch.context() as patch:
        patch.setattr(checkpoints, "save", lambda *words, **options: send())
        with pytest.raises(KeyboardInterrupt):
            run.train(request_in(tmp_path / "parts"))
    assert not (tmp_path / "parts" / "model.safetensors").exists()
    run.train(request_in(tmp_path / "parts", resume=True))
    assert_same(tmp_path / "parts", whole)


@pytest.mark.slow
def test_signals_while_it_saves_do_not_stop_that(tmp_path, model, request_in, whole, monkeypatch):
    """However often: an impatient user, `timeout` with its two signals."""
    write = run_files.write_checkpoint

    def bothered(*words, **options):
        send(signal.SIGINT)
        monkeypatch.setattr(interruption, "REPEAT_SECONDS", 0.0)
        send(signal.SIGINT)
        send(signal.SIGTERM)
        write(*words, **options)

    with monkeypatch.context() as patch:
        patch.setattr(run_files, "write_checkpoint", bothered)
        assert ended(model, request_in(tmp_path / "parts"), at=2) == (3, 2)
    run.train(request_in(tmp_path / "parts", resume=True))
    assert_same(tmp_path / "parts", whole)


@pytest.mark.slow
def test_a_second_wish_does_not_wait_and_saves_no_half_step(tmp_path, model, request_in, monkeypatch):
    monkeypatch.setattr(interruption, "REPEAT_SECONDS", -1.0)

    def twice():
        send()
        send()
        pytest.fail("the second does not wait")

    assert ended(model, request_in(tmp_path / "run", checkpoint_minutes=0.0), at=3, how=twice) == (3, 2)


def test_ended_before_the_first_step_it_saves_nothing(tmp_path, model, request_in, monkeypatch):
    """What is there then cannot be told from a fresh start, and a checkpoint would only stand in its way."""
    interruption.raise_on_signals()
    monkeypatch.setattr(DeferredSignals, "let_through", None)

    def held_from_the_beginning(words):
        held = DeferredSignals(words)
        held.receive(signal.SIGTERM, None)
        return held

    monkeypatch.setattr(interruption, "DeferredSignals", held_from_the_beginning)
    with pytest.raises(KeyboardInterrupt):
        run.train(request_in(tmp_path / "run"))
    assert not (tmp_path / "run" / "checkpoint.json").exists()


# The command line.


def train_words(data, out, *words):
    return (
        "train",
        "lstm-gmm",
        "--data",
        data,
        "-o",
        out,
        "--steps",
        6,
        "--batch",
        4,
        "--window",
        20,
        "--width",
        8,
        "--components",
        2,
        "--device",
        "cpu",
        *words,
    )


@pytest.mark.slow
def test_the_command_says_in_one_line_how_to_go_on(tmp_path, data, monkeypatch, capsys):
    out, step = tmp_path / "my run", lstm_gmm.DensityTrainer.train_step

    def signalled(trainer):
        if trainer.step == 3:
            send(signal.SIGINT)
        return step(trainer)

    interruption.raise_on_signals()
    with monkeypatch.context() as patch:
        patch.setattr(lstm_gmm.DensityTrainer, "train_step", signalled)
        assert mapctl_run(*train_words(data, out, "--match", "walk-[0-9]")) == 130
    told = capsys.readouterr().err
    begin, _, typed = told.partition("go on with: ")
    assert begin == "mapctl: interrupted; step 4 is saved; "
    assert typed.endswith(" --resume\n")
    assert typed.count("\n") == 1
    words = shlex.split(typed)
    assert words[0] == "mapctl"
    assert mapctl_run(*words[1:]) == 0
    capsys.readouterr()
    assert mapctl_run(*train_words(data, tmp_path / "whole", "--match", "walk-[0-9]")) == 0
    assert (out / "model.safetensors").read_bytes() == (tmp_path / "whole" / "model.safetensors").read_bytes()


def test_the_command_says_where_nothing_is_saved(tmp_path, data, monkeypatch, capsys):
    interruption.raise_on_signals()
    monkeypatch.setattr(clips, "read_clip_features", lambda file, **told: send(signal.SIGINT))
    assert mapctl_run(*train_words(data, tmp_path / "run")) == 130
    assert capsys.readouterr().err == "mapctl: interrupted; nothing was saved yet\n"
    assert not (tmp_path / "run").exists()


def test_every_option_is_in_the_line():
    words = [
        "train",
        "denoiser",
        "--data",
        "my data",
        "-o",
        "run",
        "--match=-walk",
        "--width",
        "7",
        "--quiet",
        "--skip-first",
        "--learning-rate",
        "0.0003",
        "--seed",
        "0",
        "--strict-data",
    ]
    given = cli.parse(words)
    assert isinstance(given, TrainOptions)
    assert cli.parse(given.format_command()[1:]) == given


def test_a_full_disk_ends_it_with_its_last_checkpoint(tmp_path, data, monkeypatch, capsys):
    write, space = tensor_files.save_file, iter([True, True, True])  # the corpus' cache and two checkpoints

    def full(*words, **options):
        if not next(space, False):
            raise SafetensorError("Error while serializing: I/O error: No space left on device (os error 28)")
        write(*words, **options)

    monkeypatch.setattr(tensor_files, "save_file", full)
    words = train_words(data, tmp_path / "run", "--minutes-between-checkpoints", 1e-9)
    assert mapctl_run(*words) == 2
    told = capsys.readouterr().err
    place = tmp_path / "run" / "step-3-checkpoint.safetensors"
    assert told.startswith(f"mapctl: cannot write {place}: No space left on device; step 2 is saved; go on with: ")
    left = {file.name for file in (tmp_path / "run").iterdir()}
    assert left == {"cache", "checkpoint.json", "losses.csv", "step-2-checkpoint.safetensors"}
    monkeypatch.undo()
    assert mapctl_run(*words, "--resume") == 0


@pytest.mark.slow  # another process is ended in test_cli_processes.py
def test_a_process_ends_so(tmp_path, data):
    words = ["1000000" if word == 6 else str(word) for word in train_words(data, tmp_path / "run")]
    with subprocess.Popen(
        [sys.executable, "-m", "mapctl.cli", *words], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None
        while not process.stdout.readline().startswith("step"):
            assert process.poll() is None
        process.send_signal(signal.SIGTERM)
        process.send_signal(signal.SIGTERM)  # as `timeout` does
        _, told = process.communicate(timeout=60)
    assert process.returncode == 143
    assert re.fullmatch(r"mapctl: terminated; step \d+ is saved; go on with: mapctl train .* --resume\n", told)
