"""Checkpoints of a training run: everything that a bit-exact continuation needs, as safetensors and JSON."""

import json
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError
from safetensors.torch import load_file, save_file

from mapctl.errors import CheckpointError
from mapctl.formats.atomic import atomic_path
from priors.checkpoints import as_json
from priors.training.lstm_gmm import Trainer

Curve = list[dict[str, float | None]]
"""A row for each validation."""

_TENSORS, _INDEX = "checkpoint.safetensors", "checkpoint.json"
# What json, safetensors and torch raise for files that are damaged or are something else.
_BROKEN = (OSError, ValueError, KeyError, TypeError, AttributeError, IndexError, RuntimeError, SafetensorError)


def exists(run: Path) -> bool:
    """Whether the run folder holds a checkpoint."""
    return (run / _INDEX).exists()


def save(run: Path, trainer: Trainer, curve: Curve, data: Mapping[str, str]) -> None:
    """Write the trainer's state. The index names the tensors' file of its own step, so a kill between leaves a pair.

    `data` says what is trained on (see `Corpus.identity`); a run goes on with the same only.
    """
    tensors = {f"model.{name}": t.contiguous() for name, t in trainer.model.state_dict().items()}
    for number, entries in trainer.optimiser.state_dict()["state"].items():
        tensors |= {f"optimiser.{number}.{key}": torch.as_tensor(value) for key, value in entries.items()}
    tensors["generator"] = trainer.generator.get_state()
    name = f"step-{trainer.step}-{_TENSORS}"
    index = {"tensors": name, "step": trainer.step, **_recipe(trainer, data), "curve": curve}
    text = as_json(index, run / _INDEX)
    with atomic_path(run / name) as scratch:
        save_file(tensors, scratch)
    with atomic_path(run / _INDEX) as scratch:
        scratch.write_text(text, encoding="utf-8")
    for old in run.glob(f"step-*-{_TENSORS}"):
        if old.name != name:
            old.unlink()


def load(run: Path, trainer: Trainer, data: Mapping[str, str]) -> Curve:
    """Put the trainer where the checkpoint was; CheckpointError if it cannot be read, or names what has changed since
    it was written: the recipe, the network or the data.
    """
    try:
        index = json.loads((run / _INDEX).read_text(encoding="utf-8"))
        curve = [dict(row) for row in index["curve"]]
        for part, now in _recipe(trainer, data).items():
            _check_same(run, part, then=index[part], now=now)
        _restore(trainer, load_file(run / index["tensors"]), step=index["step"])
    except _BROKEN as error:
        why = " ".join(f"{type(error).__name__}: {error}".split())
        raise CheckpointError(f"{run}: no readable checkpoint ({why})") from error
    return curve


def _recipe(trainer: Trainer, data: Mapping[str, str]) -> dict[str, dict[str, Any]]:
    """What must not change between a run's parts."""
    return {"settings": asdict(trainer.settings), "network": trainer.model.config.as_card(), "data": dict(data)}


def _check_same(run: Path, part: str, *, then: Mapping[str, Any], now: Mapping[str, Any]) -> None:
    changed = [f"{name}: {then.get(name)} then, {value} now" for name, value in now.items() if then.get(name) != value]
    if changed:
        raise CheckpointError(f"{run}: the run was begun with other {part} ({'; '.join(changed)})")


def _restore(trainer: Trainer, tensors: Mapping[str, torch.Tensor], *, step: int) -> None:
    state: dict[int, dict[str, torch.Tensor]] = {}
    for name, tensor in tensors.items():
        if name.startswith("optimiser."):
            _, number, key = name.split(".", 2)
            state.setdefault(int(number), {})[key] = tensor
    # Torch takes a partial state, and fails at the next step.
    if (
        len(state) != len(list(trainer.model.parameters()))
        or len({frozenset(entries) for entries in state.values()}) > 1
    ):
        raise KeyError("the optimiser's state is not whole")
    groups = trainer.optimiser.state_dict()["param_groups"]
    trainer.load_state({
        "model": {n.removeprefix("model."): t for n, t in tensors.items() if n.startswith("model.")},
        "optimiser": {"state": state, "param_groups": groups}, "generator": tensors["generator"], "step": int(step),
    })  # fmt: skip
