"""`mapctl info`: what is installed: priors and their cards, scenes, versions, rendering, threads; or what a clip is."""

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch

import scenes
from mapctl import report
from mapctl.commands.info import Info, clip
from mapctl.commands.shared import outputs
from mapctl.commands.shared.tables import print_table
from mapctl.errors import RequestError
from priors import checkpoints
from priors.tweening.styles import count_clips

NOTICE = "The code is MIT. Weights trained on Bandai Namco data are CC BY-NC 4.0, as that data is."


def run(command: Info) -> int:
    """Collect and print."""
    if command.name is not None and clip.is_clip(command.name):
        clip.print_clip(Path(command.name), command.rig, as_json=command.json, picture=command.out)
    elif command.out is not None and command.name is not None and command.rig is None:
        _plot_training(command.name, command.out)
    elif command.out is not None:
        raise RequestError("--out is a picture of a clip's rig or a run's training: mapctl info CLIP|RUN -o FILE.png")
    elif command.rig is not None:
        raise RequestError("--rig is of a clip: mapctl info CLIP --rig PRESET|FILE.toml|CLIP")
    elif command.name is not None:
        print(report.to_json(read_prior_card(command.name)), end="")
    elif command.json:
        found = {"priors": list_priors(), "installation": describe_installation(), "notice": NOTICE}
        print(report.to_json(found), end="")
    else:
        _print_tables()
    return 0


def _plot_training(name: str, path: Path) -> None:
    """Draw how a run or prior was trained, and say what was written."""
    outputs.check_picture(path, given=Path(name))
    from mapctl.commands.train.curves import plot_run

    count = plot_run(name, path)
    print(f"wrote {path} ({count} curves)")


def _print_tables() -> None:
    columns = ["prior", "kind", "size", "speeds", "licence of the weights"]
    rows = [
        [row["name"], row["kind"], f"{row['megabytes']:.1f} MB", _format_speeds(row), row["licence"]]
        for row in list_priors()
    ]
    print_table(columns, rows or [["none is bundled", None, None, None, None]])
    print_table(["installation", ""], [[name, str(value)] for name, value in describe_installation().items()])
    print(NOTICE)


def read_prior_card(name: str) -> dict[str, Any]:
    """Read the whole card of a prior, and its path; classes of motion without their vectors, with how many clips each
    is of. CheckpointError if there is none."""
    path = checkpoints.locate(name)
    card = checkpoints.read_card(path.with_suffix(".json"))
    return {"file": str(path), **vars(card), "data": count_clips(card.data)}


def list_priors() -> list[dict[str, Any]]:
    """List the bundled priors in short."""
    return [_summarise_prior(name, read_prior_card(name)) for name in checkpoints.list_bundled()]


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


def _summarise_prior(name: str, whole: Mapping[str, Any]) -> dict[str, Any]:
    size = Path(whole["file"]).stat().st_size / 1e6
    kept = {key: whole[key] for key in ("kind", "licence", "abilities", "config")}
    return {"name": name, **kept, "megabytes": size}


def _format_speeds(row: Mapping[str, Any]) -> str:
    limits = row["abilities"]
    return f"{limits['slowest']:.1f} to {limits['fastest']:.1f} m/s" if limits else "-"
