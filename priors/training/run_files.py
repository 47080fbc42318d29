"""The checkpoint of a training run on disk: tensors and an index that names them, replaced together."""

import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError
from safetensors.torch import load

from mapctl.errors import CheckpointError, RequestError
from mapctl.formats.atomic import atomic_path, check_folder
from priors.checkpoints import encode_json
from priors.tensor_files import write_tensors
from priors.training.parallel import TrainingGroup

_TENSORS, _INDEX = "checkpoint.safetensors", "checkpoint.json"
_MOVED = "moved"  # how many weights an optimiser has moved

# What json, safetensors and torch raise for files that are damaged or are something else.
UNREADABLE_ERRORS = (
    OSError,
    ValueError,
    KeyError,
    TypeError,
    AttributeError,
    IndexError,
    RuntimeError,
    SafetensorError,
)


def has_checkpoint(run: Path) -> bool:
    """Whether the run folder holds a checkpoint."""
    return (run / _INDEX).exists()


def check_run_folder(run: Path, *, resume: bool) -> None:
    """Before anything is read: the folder can be written, and holds a checkpoint if and only if it is to be resumed."""
    check_folder(run)
    present = has_checkpoint(run)
    if resume and not present:
        raise CheckpointError(f"{run} holds no checkpoint to resume from")
    if present and not resume:
        raise RequestError(f"{run} already holds a run; pass --resume to continue it, or choose another folder")


def write_checkpoint(run: Path, *, step: int, tensors: Mapping[str, torch.Tensor], index: Mapping[str, Any]) -> None:
    """The index names the tensors' file of its own step, so a kill between the two leaves a pair that fits.

    RequestError where they cannot be written, as on a full disk; the last pair is then as it was.
    """
    name = f"step-{step}-{_TENSORS}"
    text = encode_json({"tensors": name, "step": step, **index}, run / _INDEX)
    with atomic_path(run / _INDEX) as scratch:
        scratch.write_text(text, encoding="utf-8")
        write_tensors(run / name, tensors)
    for old in run.glob(f"step-*-{_TENSORS}"):
        if old.name != name:
            old.unlink()


def share_checkpoint(run: Path, group: TrainingGroup) -> tuple[dict[str, Any], dict[str, torch.Tensor]]:
    """Index and tensors, which the first process of the group reads; one of UNREADABLE_ERRORS where they cannot be."""
    index = json.loads(group.do_first((run / _INDEX).read_bytes))
    return index, load(group.do_first(lambda: (run / index["tensors"]).read_bytes()))


def parse_losses(index: Mapping[str, Any], guards: Sequence[str]) -> list[dict[str, Any]]:
    """The losses since the last report that an index holds; none where it is of an older version, without guards."""
    rows = index["losses"] if guards else index.get("losses", [])
    if any(name not in row for row in rows for name in guards):
        raise KeyError("losses without those that guard the run")
    return [{name: math.nan if value is None else value + 0 for name, value in row.items()} for row in rows]


def parse_processes(run: Path, index: Mapping[str, Any]) -> int:
    """How many processes shared a step. CheckpointError for a run of an older version, in which each had a whole batch
    of its own."""
    found = index.get("processes", 1)
    if isinstance(found, dict) and found["number"] > 1:
        raise CheckpointError(f"{run} is a run of an older version, whose processes had a whole batch each")
    return 1 if isinstance(found, dict) else int(found)


def read_total_steps(run: Path) -> int | None:
    """Read how many steps the run of the folder's checkpoint has in all; None where there is none that can be read."""
    try:
        index = json.loads((run / _INDEX).read_text(encoding="utf-8"))
        settings = index["settings"]
        return int(index.get("steps") or settings.get("steps") or settings["rounds"])
    except UNREADABLE_ERRORS:
        return None


def read_licence(run: Path) -> str | None:
    """Read the licence that the run of the folder's checkpoint was begun with; None where none is told."""
    try:
        return str(json.loads((run / _INDEX).read_text(encoding="utf-8"))["licence"])
    except UNREADABLE_ERRORS:
        return None


def parse_curve(index: Mapping[str, Any], count: str) -> list[dict[str, Any]]:
    """The curve that an index holds; one of UNREADABLE_ERRORS unless every row says at what `count` it was measured."""
    return [{**row, count: int(row[count])} for row in index["curve"]]


def read_last_step(run: Path) -> int | None:
    """Read the step of the run folder's checkpoint; None where there is none that can be read."""
    try:
        return int(json.loads((run / _INDEX).read_text(encoding="utf-8"))["step"])
    except UNREADABLE_ERRORS:
        return None


def flatten_optimiser(optimiser: torch.optim.Optimizer, prefix: str) -> dict[str, torch.Tensor]:
    """What an optimiser keeps of each weight that it has moved, flat, and how many these are."""
    state = optimiser.state_dict()["state"]
    return {
        f"{prefix}.{number}.{key}": torch.as_tensor(value)
        for number, entries in state.items()
        for key, value in entries.items()
    } | {f"{prefix}.{_MOVED}": torch.tensor(len(state))}


def unflatten_optimiser(
    optimiser: torch.optim.Optimizer, prefix: str, tensors: Mapping[str, torch.Tensor]
) -> dict[str, Any]:
    """For `load_state_dict`, from what `flatten_optimiser` gave; KeyError unless it is whole."""
    state: dict[int, dict[str, torch.Tensor]] = {}
    kept = select_prefixed(f"{prefix}.", tensors)
    groups = optimiser.state_dict()["param_groups"]
    everything = sum(len(group["params"]) for group in groups)
    moved = int(kept.pop(_MOVED, everything))
    for name, tensor in kept.items():
        number, key = name.split(".", 1)
        state.setdefault(int(number), {})[key] = tensor
    # Torch takes a partial state, and fails at the next step or begins anew.
    if len(state) != moved or len(set(map(frozenset, state.values()))) > 1:
        raise KeyError("the optimiser's state is not whole")
    return {"state": state, "param_groups": groups}


def select_prefixed(prefix: str, tensors: Mapping[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    """Those whose names begin so, without it."""
    return {name.removeprefix(prefix): tensor for name, tensor in tensors.items() if name.startswith(prefix)}


def check_unchanged(run: Path, part: str, *, then: Mapping[str, Any], now: Mapping[str, Any]) -> None:
    """CheckpointError that names what has changed since the run was begun."""
    changed = [f"{name}: {then.get(name)} then, {value} now" for name, value in now.items() if then.get(name) != value]
    if changed:
        raise CheckpointError(f"{run}: the run was begun with other {part} ({'; '.join(changed)})")


def make_unreadable_error(run: Path, error: Exception) -> CheckpointError:
    """For a checkpoint that raised one of UNREADABLE_ERRORS."""
    return CheckpointError(f"{run}: no readable checkpoint ({' '.join(f'{type(error).__name__}: {error}'.split())})")
