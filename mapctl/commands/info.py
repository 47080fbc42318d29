"""`mapctl info`: what is installed: priors and their cards, scenes, versions, rendering, threads; or what a clip is."""

import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from tyro.conf import Positional, arg

from mapctl.commands.shared import clip_info, options
from mapctl.commands.shared.tables import print_table
from mapctl.errors import RequestError

NOTICE = "The code is MIT. Weights trained on Bandai Namco data are CC BY-NC 4.0, as that data is."


@dataclass(frozen=True)
class Info:
    """Bundled priors with their cards and licences, scenes, versions, rendering back end, threads; or a clip's rig."""

    name: Positional[Annotated[str | None, arg(metavar="NAME|CLIP")]] = None
    """A prior whose whole card is printed, as JSON: bundled, a file, or a run folder. Or a clip (.bvh, .npz), of which
    rig, joints, unit, axes and length are told."""
    rig: options.MaybeRig = None
    """The clip's rig, where it is not the one that would be recognised."""
    json: bool = False
    """Print JSON instead of tables."""

    def run(self) -> int:
        """Collect and print."""
        from mapctl import report

        if self.name is not None and clip_info.is_clip(self.name):
            clip_info.print_clip(Path(self.name), self.rig, as_json=self.json)
        elif self.rig is not None:
            raise RequestError("--rig is of a clip: mapctl info CLIP --rig PRESET|FILE.toml|CLIP")
        elif self.name is not None:
            print(report.to_json(read_prior_card(self.name)), end="")
        elif self.json:
            print(
                report.to_json({"priors": list_priors(), "installation": describe_installation(), "notice": NOTICE}),
                end="",
            )
        else:
            self._tables()
        return 0

    def _tables(self) -> None:
        columns = ["prior", "kind", "size", "speeds", "licence of the weights"]
        rows = [
            [row["name"], row["kind"], f"{row['megabytes']:.1f} MB", _format_speeds(row), row["licence"]]
            for row in list_priors()
        ]
        print_table(columns, rows or [["none is bundled", None, None, None, None]])
        print_table(["installation", ""], [[name, str(value)] for name, value in describe_installation().items()])
        print(NOTICE)


def read_prior_card(name: str) -> dict[str, Any]:
    """The whole card of a prior, and where it lies; CheckpointError if there is none."""
    from priors import checkpoints

    path = checkpoints.locate(name)
    return {"file": str(path), **vars(checkpoints.read_card(path.with_suffix(".json")))}


def list_priors() -> list[dict[str, Any]]:
    """The bundled priors in short."""
    from priors import checkpoints

    return [_summarise_prior(name, read_prior_card(name)) for name in checkpoints.list_bundled()]


def describe_installation() -> dict[str, Any]:
    """Versions, scenes, rendering back end, threads and cores."""
    import torch

    import scenes
    from mapctl import report

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
    able = row["abilities"]
    return f"{able['slowest']:.1f} to {able['fastest']:.1f} m/s" if able else "-"
