"""Checkpoints of a density's training run: everything that a bit-exact continuation needs."""

from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch

from priors.training import run_files
from priors.training.recipes.lstm_gmm import Trainer

Curve = list[dict[str, float | None]]
"""A row for each validation."""


def save(run: Path, trainer: Trainer, curve: Curve, data: Mapping[str, str]) -> None:
    """Write the trainer's state. `data` says what is trained on (see `Corpus.identity`); a run goes on with the same
    only.
    """
    tensors = {f"model.{name}": tensor for name, tensor in trainer.model.state_dict().items()}
    tensors |= run_files.optimiser_tensors(trainer.optimiser, "optimiser")
    tensors["generator"] = trainer.generator.get_state()
    run_files.write(run, step=trainer.step, tensors=tensors, index={**_recipe(trainer, data), "curve": curve})


def load(run: Path, trainer: Trainer, data: Mapping[str, str]) -> Curve:
    """Put the trainer where the checkpoint was; CheckpointError if it cannot be read, or names what has changed since
    it was written: the recipe, the network or the data.
    """
    try:
        index, tensors = run_files.read(run)
        curve = run_files.rows(index, "step")
        for part, now in _recipe(trainer, data).items():
            run_files.check_same(run, part, then=index[part], now=now)
        _restore(trainer, tensors, step=index["step"])
    except run_files.BROKEN as error:
        raise run_files.unreadable(run, error) from error
    return curve


def _recipe(trainer: Trainer, data: Mapping[str, str]) -> dict[str, dict[str, Any]]:
    """What must not change between a run's parts."""
    return {"settings": asdict(trainer.settings), "network": trainer.model.config.as_card(), "data": dict(data)}


def _restore(trainer: Trainer, tensors: Mapping[str, torch.Tensor], *, step: int) -> None:
    trainer.load_state(
        {
            "model": {n.removeprefix("model."): t for n, t in tensors.items() if n.startswith("model.")},
            "optimiser": run_files.optimiser_state(trainer.optimiser, "optimiser", tensors),
            "generator": tensors["generator"],
            "step": int(step),
        }
    )
