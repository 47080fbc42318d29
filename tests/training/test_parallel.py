"""Training in several processes: gradients of their batches are averaged, nothing else differs."""

import gc
import math
import multiprocessing
import os
import signal
import time

import pytest
import torch
from helpers import corpus, killing
from tiny_transformer import CONFIG

from mapctl.errors import MapctlError
from priors.training.recipes.pose_transformer import (
    PoseTransformerRecipe,
    PoseTransformerSettings,
    PoseTransformerTrainer,
)
from priors.training.run import train

SETTINGS = PoseTransformerSettings(steps=6, batch=100, window=32)


def make_trainer(processes=1):
    trainer = PoseTransformerTrainer(CONFIG, SETTINGS, corpus(2, 60))
    trainer.processes = processes
    return trainer


def gradients_of(trainer):
    return {name: weight.grad.clone() for name, weight in trainer.network.named_parameters()}


def find_gradients(trainer, state=None, seed=None):
    """As one process finds them for the batch of this state or seed."""
    if seed is None:
        trainer.generator.set_state(state)
    else:
        trainer.generator.manual_seed(seed)
    trainer.network.zero_grad()
    parts = trainer.losses()
    parts["loss"].backward()
    return gradients_of(trainer), {name: float(value.detach()) for name, value in parts.items()}


def test_a_step_of_three_processes_has_the_mean_gradient_of_three_batches(monkeypatch):
    trainer, alone = make_trainer(processes=3), make_trainer()
    trainer.network.load_state_dict(alone.network.state_dict())
    draws = torch.Generator()
    draws.set_state(trainer.generator.get_state())
    seeds = [int(torch.randint(2**62, (), generator=draws)) for _ in range(2)]
    batches = [find_gradients(alone, state=draws.get_state()), *(find_gradients(alone, seed=seed) for seed in seeds)]
    monkeypatch.setattr(trainer, "limit_gradients", lambda: None)
    told = trainer.train_step()
    for name, gradient in gradients_of(trainer).items():
        mean = sum(found[name] for found, _ in batches) / 3
        assert torch.allclose(gradient, mean, atol=1e-6 + 1e-4 * float(mean.abs().max())), name
    assert told["places_cm"] == pytest.approx(sum(parts["places_cm"] for _, parts in batches) / 3, rel=1e-4)


def test_helpers_see_the_weights_of_every_step():
    trainer = make_trainer(processes=2)
    for _ in range(4):
        trainer.generator.manual_seed(1)
        rows = trainer.train_step()
    assert rows["loss"] < 0.999 * _first_loss()


def _first_loss():
    trainer = make_trainer(processes=2)
    trainer.generator.manual_seed(1)
    return trainer.train_step()["loss"]


def test_killed_and_resumed_is_the_uninterrupted_run_to_the_bit(tmp_path, data):
    def wanted(out, **changes):
        return PoseTransformerRecipe(
            data, out, settings=SETTINGS, config=CONFIG, processes=2, checkpoint_minutes=0.0, **changes
        )

    train(wanted(tmp_path / "whole"))
    with killing(PoseTransformerTrainer, 3):
        train(wanted(tmp_path / "parts"))
    train(wanted(tmp_path / "parts", resume=True))
    for name in ("model.safetensors", "model.json"):
        assert (tmp_path / "parts" / name).read_bytes() == (tmp_path / "whole" / name).read_bytes(), name
    card = (tmp_path / "whole" / "model.json").read_text()
    assert "--processes 2" in card
    with pytest.raises(MapctlError, match="begun with other processes"):
        train(PoseTransformerRecipe(data, tmp_path / "whole", settings=SETTINGS, config=CONFIG, resume=True))


def test_a_helper_that_fails_is_told(monkeypatch):
    trainer = make_trainer(processes=2)
    trainer.train_step()
    monkeypatch.setattr(trainer, "losses", lambda: {"loss": trainer.network.head.weight.sum()})
    for child in multiprocessing.active_children():
        child.kill()
    with pytest.raises(MapctlError, match="computes gradients failed: it was killed"):
        trainer.train_step()


def test_an_error_of_a_helper_is_told_in_its_words(monkeypatch):
    trainer, here = make_trainer(processes=2), multiprocessing.current_process().pid
    losses = trainer.losses

    def fail_elsewhere():
        if multiprocessing.current_process().pid != here:
            raise ValueError("no such window")
        return losses()

    monkeypatch.setattr(trainer, "losses", fail_elsewhere)
    with pytest.raises(MapctlError, match="failed: ValueError: no such window"):
        trainer.train_step()


def test_helpers_outlast_signals_and_end_with_their_trainer():
    before = set(multiprocessing.active_children())
    trainer = make_trainer(processes=2)
    trainer.train_step()
    (helper,) = set(multiprocessing.active_children()) - before
    assert helper.pid is not None
    for kind in (signal.SIGINT, signal.SIGTERM):
        os.kill(helper.pid, kind)
    assert math.isfinite(trainer.train_step()["loss"])
    del trainer
    gc.collect()
    deadline = time.monotonic() + 10
    while helper.is_alive() and time.monotonic() < deadline:
        time.sleep(0.05)
    assert not helper.is_alive()
