"""Training in several processes: they share the batch of a step, and their gradients are averaged; nothing else
differs.
"""

import gc
import json
import multiprocessing
import os
import shutil
import signal
import socket
import subprocess
import sys
from dataclasses import replace

import pytest
import torch
from ended_models import MODELS, VARIANTS, list_params
from helpers import corpus, killing
from helpers import run as mapctl_run
from tiny_infiller import CONFIG as INFILLER
from tiny_transformer import CONFIG

from mapctl.errors import CheckpointError, MapctlError, RequestError
from mapctl.runtime import interruption
from priors.training.parallel import ALONE, LostProcessError, TrainingGroup, count_launched, fork_group
from priors.training.recipes.infiller import InfillerRecipe, InfillerSettings, InfillerTrainer
from priors.training.recipes.pose_transformer import PoseTransformerSettings, PoseTransformerTrainer
from priors.training.run import train

SETTINGS = InfillerSettings(steps=6, batch=4, window=32)
FILES = ("model.safetensors", "model.json", "losses.csv")


def find_trainers():
    """The processes of a training that still run; other tests' workers wait for more work."""
    return [child for child in multiprocessing.active_children() if "Loky" not in type(child).__name__]


pytestmark = pytest.mark.usefixtures("small_judgements")


def wanted(data, out, **changes):
    given = {"processes": 2, "validate_steps": 2, "report_steps": 2, "checkpoint_minutes": 0.0}
    return InfillerRecipe(data, out, config=INFILLER, settings=SETTINGS, **given | changes)


def make_trainer():
    return PoseTransformerTrainer(
        CONFIG, PoseTransformerSettings(steps=6, batch=192, window=32, optimiser="adam"), corpus(2, 60)
    )


def gather_rows(work, count, rows=1):
    """What `work` finds in each of `count` processes, by row."""
    found = []

    def told(group):
        found.append(group.gather(work(group).reshape(rows, -1)))

    with fork_group(count, told) as group:
        told(group)
    return found[0]


def gradient_after_a_step(group):
    trainer = make_trainer()
    trainer.limit_gradients = lambda: None
    trainer.join(group)
    trainer.take_step()
    return torch.cat([weight.grad.flatten() for weight in trainer.network.parameters()])


@pytest.mark.slow
def test_a_step_of_three_processes_has_the_mean_gradient_of_three_shares_of_a_batch():
    rows = gather_rows(gradient_after_a_step, 3)
    assert torch.equal(rows[0], rows[1])
    assert torch.equal(rows[0], rows[2])
    common = torch.Generator().manual_seed(1)
    seeds = torch.randint(2**62, (3,), generator=common)
    own = []
    for rank, seed in enumerate(seeds):
        trainer = make_trainer()
        trainer.group, trainer.common = TrainingGroup(rank, 3), torch.Generator()
        trainer.common.set_state(common.get_state())
        trainer.generator.manual_seed(int(seed))
        trainer.losses()["loss"].backward()
        own.append(torch.cat([weight.grad.flatten() for weight in trainer.network.parameters()]))
    assert not torch.allclose(own[0], own[1], rtol=0.01)
    assert torch.allclose(rows[0], sum(own) / 3, atol=1e-6 + 1e-5 * float(rows.abs().max()))


def test_processes_share_a_batch_between_them():
    shares = [[TrainingGroup(rank, size).share(count) for rank in range(size)] for count, size in ((7, 3), (2, 4))]
    assert shares == [[3, 2, 2], [1, 1, 1, 1]]
    trainer, drawn = InfillerTrainer(INFILLER, SETTINGS, corpus(2, 60)), []
    trainer.group = TrainingGroup(1, 2)
    draw = trainer.windows.draw
    trainer.windows.draw = lambda batch, generator: drawn.append(batch) or draw(batch, generator)
    trainer.losses()
    assert drawn == [2]


@pytest.mark.slow
def test_all_processes_draw_windows_of_one_length():
    def frames(group):
        trainer, found = make_trainer(), []
        trainer.join(group)
        draw = trainer.windows.draw
        trainer.windows.draw = lambda batch, count, *more, **named: (
            found.append(count) or draw(batch, count, *more, **named)
        )
        for _ in range(4):
            trainer.take_step()
        return torch.tensor(found)

    lengths = gather_rows(frames, 2)
    assert lengths[0].tolist() == lengths[1].tolist()
    assert len(set(lengths[0].tolist())) > 1


@pytest.mark.slow
def test_a_gradient_that_only_one_process_has_counts_half_and_one_that_none_has_stays_away():
    def average(group):
        weights = [torch.nn.Parameter(torch.zeros(2)) for _ in range(3)]
        weights[0].grad = torch.full((2,), float(group.rank + 1))
        if group.rank == 1:
            weights[1].grad = torch.ones(2)
        (mean,) = group.average_gradients(weights, [torch.tensor(3.0 + group.rank)])
        assert weights[2].grad is None
        return torch.cat([weights[0].grad, weights[1].grad, mean.reshape(1)])

    assert gather_rows(average, 2).tolist() == 2 * [[1.5, 1.5, 0.5, 0.5, 3.5]]


@pytest.mark.slow
def test_two_processes_train_the_same_to_the_bit_each_time_also_when_killed_and_resumed(tmp_path, data):
    train(wanted(data, tmp_path / "whole"))
    train(wanted(data, tmp_path / "again"))
    with killing(InfillerTrainer, 3):
        train(wanted(data, tmp_path / "parts"))
    train(wanted(data, tmp_path / "parts", resume=True))
    train(wanted(data, tmp_path / "alone", processes=1))
    for name in FILES:
        told = [(tmp_path / run / name).read_bytes() for run in ("whole", "again", "parts", "alone")]
        assert told[0] == told[1] == told[2], name
        assert told[3] != told[0], name
    assert "--processes 2" in json.loads((tmp_path / "whole" / "model.json").read_text())["training"]["command"]
    assert not find_trainers()


PARALLEL = [name for name in MODELS | VARIANTS if name not in ("keyframe-timing", "infiller")]


@pytest.mark.slow
@pytest.mark.parametrize("name", list_params(PARALLEL))
def test_every_model_trains_in_two_processes_and_goes_on_to_the_bit(name, tmp_path, data, prior):
    model = (MODELS | VARIANTS)[name]
    recipe = replace(model.recipe(data, tmp_path / "parts", prior), processes=2, checkpoint_minutes=0.0)
    with killing(model.trainer, 4):
        train(recipe)
    train(replace(recipe, resume=True))
    train(replace(recipe, out=tmp_path / "whole", checkpoint_minutes=3.0))
    for file in FILES:
        assert (tmp_path / "parts" / file).read_bytes() == (tmp_path / "whole" / file).read_bytes(), file


@pytest.mark.slow
def test_another_number_of_processes_goes_on_and_says_that_the_result_differs(tmp_path, data):
    with killing(InfillerTrainer, 3):
        train(wanted(data, tmp_path / "run"))
    warnings = []
    assert train(wanted(data, tmp_path / "run", resume=True, processes=1), warn=warnings.append).exists()
    assert len(warnings) == 1
    assert "was trained in 2 processes and goes on in 1: the result is as good, but not the same" in warnings[0]


@pytest.mark.slow
def test_a_run_whose_processes_had_a_batch_each_is_refused(tmp_path, data):
    with killing(InfillerTrainer, 3):
        train(wanted(data, tmp_path / "run"))
    file = tmp_path / "run" / "checkpoint.json"
    file.write_text(json.dumps(json.loads(file.read_text()) | {"processes": {"number": 2}}))
    with pytest.raises(CheckpointError, match="older version, whose processes had a whole batch each"):
        train(wanted(data, tmp_path / "run", resume=True))


def fail_elsewhere(monkeypatch, fail):
    """Let the second process fail in its third step."""
    here, losses = os.getpid(), InfillerTrainer.losses

    def failing(trainer):
        if os.getpid() != here and trainer.step == 2:
            fail()
        return losses(trainer)

    monkeypatch.setattr(InfillerTrainer, "losses", failing)


@pytest.mark.slow
def test_a_process_that_is_killed_ends_the_others_with_one_line(tmp_path, data, monkeypatch):
    fail_elsewhere(monkeypatch, lambda: os.kill(os.getpid(), signal.SIGKILL))
    with pytest.raises(
        LostProcessError, match=r"process 1 of the training failed: it was killed; the last checkp.*kept"
    ):
        train(wanted(data, tmp_path / "run"))
    assert json.loads((tmp_path / "run" / "checkpoint.json").read_text())["step"] == 2
    assert not find_trainers()


@pytest.mark.slow
def test_an_error_of_a_process_is_told_in_its_words(tmp_path, data, monkeypatch):
    def fail():
        raise ValueError("no such window")

    fail_elsewhere(monkeypatch, fail)
    with pytest.raises(MapctlError, match="process 1 of the training failed: ValueError: no such window"):
        train(wanted(data, tmp_path / "run", processes=3))


@pytest.mark.slow
def test_ctrl_c_saves_a_checkpoint_of_all_processes(tmp_path, data, monkeypatch):
    step = InfillerTrainer.train_step

    def signalled(trainer):
        if trainer.step == 2:
            os.kill(os.getpid(), signal.SIGINT)  # a terminal sends it to all
        return step(trainer)

    signal.signal(signal.SIGINT, signal.default_int_handler)  # shells have it ignored by what runs in the background
    interruption.raise_on_signals()
    with monkeypatch.context() as patch:
        patch.setattr(InfillerTrainer, "train_step", signalled)
        with pytest.raises(KeyboardInterrupt):
            train(wanted(data, tmp_path / "run", checkpoint_minutes=3.0))
    assert json.loads((tmp_path / "run" / "checkpoint.json").read_text())["step"] == 3
    assert not find_trainers()


class Noted:
    """Garbage that says in which process it is thrown away."""

    def __init__(self, file):
        self.file, self.itself = file, self

    def __del__(self):
        with self.file.open("a") as opened:
            opened.write(f"{os.getpid()}\n")


@pytest.mark.slow
def test_what_is_thrown_away_before_processes_are_forked_is_not_thrown_away_in_them(tmp_path):
    """The group of an earlier run would wait there forever for threads that it had."""
    gc.disable()
    try:
        Noted(tmp_path / "thrown")
        with fork_group(2, lambda group: gc.collect()):
            pass
    finally:
        gc.enable()
    assert (tmp_path / "thrown").read_text().split() == [str(os.getpid())]


def test_nonsense_is_refused_before_anything_is_read(tmp_path, data, capsys, monkeypatch):
    words = ("train", "infiller", "--data", data, "-o", tmp_path / "run", "--batch", 4)
    for count, message in ((0, "processes must be at least 1, got 0"), (9, "share what a step of infiller takes: 4")):
        assert mapctl_run(*words, "--processes", count) == 2
        assert message in capsys.readouterr().err
    timing = ("train", "keyframe-timing", "--data", data, "-o", tmp_path / "run")
    for name, value in {"RANK": "0", "WORLD_SIZE": "2", "MASTER_ADDR": "localhost", "MASTER_PORT": "1"}.items():
        monkeypatch.setenv(name, value)
    assert mapctl_run(*timing) == 2
    assert "2 processes cannot share what a step of keyframe-timing takes: 1 at most" in capsys.readouterr().err
    assert mapctl_run(*words, "--processes", 3) == 2
    assert "torchrun has started 2 processes; leave out --processes" in capsys.readouterr().err
    monkeypatch.setenv("RANK", "7")
    with pytest.raises(RequestError, match="RANK must be one of the 2 numbers"):
        count_launched()
    assert not (tmp_path / "run").exists()
    assert ALONE.leads


def free_port():
    with socket.socket() as bound:
        bound.bind(("127.0.0.1", 0))
        return bound.getsockname()[1]


def launch(data, out, *words):
    """As torchrun starts two processes on one machine; exit statuses and what each wrote."""
    shared = {"WORLD_SIZE": "2", "MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(free_port()), "OMP_NUM_THREADS": "1"}
    command = ["train", "infiller", "--data", data, "-o", out, "--steps", 4, "--batch", 4, "--window", 40, *words]
    running = [
        subprocess.Popen(
            [sys.executable, "-m", "mapctl", *map(str, command)],
            env=os.environ | shared | {"RANK": str(rank), "LOCAL_RANK": str(rank)},
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        for rank in range(2)
    ]
    told = [process.communicate(timeout=120) for process in running]
    return [process.returncode for process in running], told


@pytest.mark.slow  # four interpreters start
def test_what_torchrun_starts_is_what_processes_are_forked(tmp_path, data):
    statuses, told = launch(data, tmp_path / "launched")
    assert statuses == [0, 0], told
    assert "step 4/4" in told[0][0]
    assert told[1] == ("", "")
    words = ["--steps", 4, "--batch", 4, "--window", 40, "--processes", 2, "--quiet"]
    assert mapctl_run("train", "infiller", "--data", data, "-o", tmp_path / "forked", *words) == 0
    for name in FILES:
        assert (tmp_path / "launched" / name).read_bytes() == (tmp_path / "forked" / name).read_bytes(), name
    (tmp_path / "empty").mkdir()
    statuses, told = launch(tmp_path / "empty", tmp_path / "none")
    assert statuses == [2, 2]
    assert told[0][1].startswith("mapctl: no .bvh")
    assert told[1] == ("", "")
    shutil.rmtree(tmp_path / "launched")
