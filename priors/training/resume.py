"""Checkpoints of a density's training run: everything that a bit-exact continuation needs."""

from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch

from priors.training import run_files
from priors.training.recipes.lstm_gmm import DensityTrainer

Curve = list[dict[str, float | None]]
"""A row for each validation."""


def save(run: Path, trainer: DensityTrainer, curve: Curve, data: Mapping[str, str]) -> None:
    """Write the trainer's state. `data` says what is trained on (see `Corpus.identity`); a run goes on with the same
    only.
    """
    tensors = {f"model.{name}": tensor for name, tensor in trainer.model.state_dict().items()}
    tensors |= run_files.flatten_optimiser(trainer.optimiser, "optimiser")
    tensors["generator"] = trainer.generator.get_state()
    run_files.write_checkpoint(
        run, step=trainer.step, tensors=tensors, index={**_describe_recipe(trainer, data), "curve": curve}
    )


def load(run: Path, trainer: DensityTrainer, data: Mapping[str, str]) -> Curve:
    """Put the trainer where the checkpoint was; CheckpointError if it cannot be read, or names what has changed since
    it was written: the recipe, the network or the data.
    """
    try:
        index, tensors = run_files.read_checkpoint(run)
        curve = run_files.parse_curve(index, "step")
        for part, now in _describe_recipe(trainer, data).items():
            run_files.check_unchanged(run, part, then=index[part], now=now)
        _restore(trainer, tensors, step=index["step"])
    except run_files.UNREADABLE_ERRORS as error:
        raise run_files.make_unreadable_error(run, error) from error
    return curve


def _describe_recipe(trainer: DensityTrainer, data: Mapping[str, str]) -> dict[str, dict[str, Any]]:
    """What must not change between a run's parts."""
    return {"settings": asdict(trainer.settings), "network": trainer.model.config.as_card(), "data": dict(data)}


def _restore(trainer: DensityTrainer, tensors: Mapping[str, torch.Tensor], *, step: int) -> None:
    trainer.load_state(
        {
            "model": {n.removeprefix("model."): t for n, t in tensors.items() if n.startswith("model.")},
            "optimiser": run_files.unflatten_optimiser(trainer.optimiser, "optimiser", tensors),
            "generator": tensors["generator"],
            "step": int(step),
        }
    )
