"""Checkpoints of a training run: everything that a bit-exact continuation needs, as safetensors and JSON."""

import json
from dataclasses import asdict
from pathlib import Path

import torch
from safetensors import SafetensorError
from safetensors.torch import load_file, save_file

from mapctl.errors import CheckpointError
from mapctl.formats.atomic import atomic_path
from priors.training.lstm_gmm import Trainer

_TENSORS, _INDEX = "checkpoint.safetensors", "checkpoint.json"


def exists(run: Path) -> bool:
    """Whether the run folder holds a checkpoint."""
    return (run / _INDEX).exists()


def save(run: Path, trainer: Trainer, curve: list[dict[str, float]]) -> None:
    """Write the trainer's state. The index names the tensors' file of its own step, so a kill between leaves a pair."""
    tensors = {f"model.{name}": t.contiguous() for name, t in trainer.model.state_dict().items()}
    for number, entries in trainer.optimiser.state_dict()["state"].items():
        tensors |= {f"optimiser.{number}.{key}": torch.as_tensor(value) for key, value in entries.items()}
    tensors["generator"] = trainer.generator.get_state()
    name = f"step-{trainer.step}-{_TENSORS}"
    with atomic_path(run / name) as scratch:
        save_file(tensors, scratch)
    index = {"tensors": name, "step": trainer.step, "settings": asdict(trainer.settings),
             "config": asdict(trainer.model.config), "curve": curve}  # fmt: skip
    with atomic_path(run / _INDEX) as scratch:
        scratch.write_text(json.dumps(index) + "\n", encoding="utf-8")
    for old in run.glob(f"step-*-{_TENSORS}"):
        if old.name != name:
            old.unlink()


def load(run: Path, trainer: Trainer) -> list[dict[str, float]]:
    """Put the trainer where the checkpoint was; CheckpointError if it is of another recipe or cannot be read."""
    try:
        index = json.loads((run / _INDEX).read_text(encoding="utf-8"))
        tensors = load_file(run / index["tensors"])
    except (OSError, ValueError, KeyError, TypeError, SafetensorError) as error:
        raise CheckpointError(f"{run}: no readable checkpoint ({error})") from error
    for part, ours in (("settings", trainer.settings), ("config", trainer.model.config)):
        changed = [
            f"{k}: {index[part].get(k)} then, {v} now" for k, v in asdict(ours).items() if index[part].get(k) != v
        ]
        if changed:
            raise CheckpointError(f"{run}: the run was begun with other settings ({'; '.join(changed)})")
    state: dict[int, dict[str, torch.Tensor]] = {}
    for name, tensor in tensors.items():
        if name.startswith("optimiser."):
            _, number, key = name.split(".", 2)
            state.setdefault(int(number), {})[key] = tensor
    groups = trainer.optimiser.state_dict()["param_groups"]
    trainer.load_state({
        "model": {n.removeprefix("model."): t for n, t in tensors.items() if n.startswith("model.")},
        "optimiser": {"state": state, "param_groups": groups}, "generator": tensors["generator"], "step": index["step"],
    })  # fmt: skip
    return index["curve"]
