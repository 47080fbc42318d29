"""`mapctl info`: what is installed: priors and their cards, scenes, versions, rendering, threads; or what a clip is."""

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch

import scenes
from mapctl import report
from mapctl.commands.info import Info, clip
from mapctl.commands.shared.tables import print_table
from mapctl.errors import RequestError
from mapctl.features import PRIOR_FPS
from priors import checkpoints, weight_sets
from priors.licences import find_strictest
from priors.tweening.styles import count_clips

NOTICE = (
    "The code is MIT. Weights trained on Bandai Namco data are CC BY-NC 4.0, as that data is; the free weights, by"
    " --weights free, may be used for anything."
)


def run(command: Info) -> int:
    """Collect and print."""
    if command.name is not None and clip.is_clip(command.name):
        clip.print_clip(Path(command.name), command)
    elif command.out is not None:
        raise RequestError("--out is a picture of a clip's rig: mapctl info CLIP -o FILE.png")
    elif command.rig is not None or command.unit is not None or command.up is not None:
        raise RequestError("--rig, --unit and --up are of a clip: mapctl info CLIP --rig PRESET|FILE.toml|CLIP")
    elif command.name is not None:
        print(report.to_json(read_prior_card(command.name)), end="")
    elif command.json:
        found = {
            "priors": list_priors(),
            "weights": describe_weights(),
            "installation": describe_installation(),
            "notice": NOTICE,
        }
        print(report.to_json(found), end="")
    else:
        _print_tables()
    return 0


def _print_tables() -> None:
    columns = ["prior", "kind", "size", "speeds", "data", "licence of the weights"]
    rows = [
        [row["name"], row["kind"], f"{row['megabytes']:.1f} MB", _format_speeds(row), _format_data(row), row["licence"]]
        for row in list_priors()
    ]
    print_table(columns, rows or [["none is bundled", *[None] * (len(columns) - 1)]])
    print_table(["weights", "models", "size", "licence"], [_format_set(name) for name in weight_sets.SETS])
    print_table(["installation", ""], [[name, str(value)] for name, value in describe_installation().items()])
    print(NOTICE)


def read_prior_card(name: str) -> dict[str, Any]:
    """Read the whole card of a prior, and its path; classes of motion without their vectors, with how many clips each
    is of. CheckpointError if there is none."""
    path = checkpoints.locate(name)
    card = checkpoints.read_card(path.with_suffix(".json"))
    return {"file": str(path), **vars(card), "data": count_clips(card.data)}


def list_priors() -> list[dict[str, Any]]:
    """List the bundled priors of all sets in short; those of the default set by their bare names."""
    return [row for weights in weight_sets.SETS for row in _list_set(weights)]


def describe_weights() -> dict[str, Any]:
    """Describe the sets of weights: which is in force, and of each its models, size and strictest licence."""
    return {"in_force": weight_sets.find_current_set(), **{name: _describe_set(name) for name in weight_sets.SETS}}


def _list_set(weights: str) -> list[dict[str, Any]]:
    rows = []
    for name in weight_sets.list_models(weights):
        whole = read_prior_card(f"{weights}/{name}")
        rows.append(_summarise_prior(name if weights == weight_sets.SETS[0] else f"{weights}/{name}", weights, whole))
    return rows


def _describe_set(weights: str) -> dict[str, Any]:
    rows = _list_set(weights)
    return {
        "models": [row["name"] for row in rows],
        "megabytes": sum(row["megabytes"] for row in rows),
        "licence": find_strictest(row["licence"] for row in rows),
    }


def describe_installation() -> dict[str, Any]:
    """Describe versions, scenes, rendering back end, threads and cores."""
    threads = {"threads of a solve": 1, "threads of torch": torch.get_num_threads(), "cores": os.cpu_count()}
    gpu = torch.cuda.get_device_name() if torch.cuda.is_available() else "none"
    return {
        **report.package_versions(),
        **threads,
        "GPU": gpu,
        "rendering": scenes.back_end(),
        "scenes": ", ".join(scenes.list_scenes()),
    }


def _summarise_prior(name: str, weights: str, whole: Mapping[str, Any]) -> dict[str, Any]:
    size = Path(whole["file"]).stat().st_size / 1e6
    kept = {key: whole[key] for key in ("kind", "licence", "abilities", "config")}
    data = {key: int(whole["data"][key]) for key in ("clips", "frames") if key in whole["data"]}
    return {"name": name, "weights": weights, **kept, "data": data, "megabytes": size}


def _format_data(row: Mapping[str, Any]) -> str:
    data = row["data"]
    minutes = data.get("frames", 0) / PRIOR_FPS / 60
    return f"{data['clips']:,} clips, {minutes:,.0f} min" if minutes else "-"


def _format_set(weights: str) -> list[str]:
    described = _describe_set(weights)
    name = f"{weights} (in force)" if weights == weight_sets.find_current_set() else weights
    if not described["models"]:
        return [name, "none is bundled", "-", "-"]
    return [name, str(len(described["models"])), f"{described['megabytes']:.1f} MB", described["licence"]]


def _format_speeds(row: Mapping[str, Any]) -> str:
    limits = row["abilities"]
    return f"{limits['slowest']:.1f} to {limits['fastest']:.1f} m/s" if limits else "-"
