"""`mapctl info`: what is installed: priors and their cards, scenes, versions, rendering, threads; or what a clip is."""

import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, ClassVar

import torch
from tyro.conf import Positional, arg

import scenes
from mapctl import formats, report, retarget
from mapctl.commands.shared import inputs, options, outputs
from mapctl.commands.shared.command import ModelCommand
from mapctl.commands.shared.outputs import print_table
from mapctl.errors import RequestError
from mapctl.features import PRIOR_FPS
from mapctl.formats import bvh
from mapctl.formats.character import CharacterSource
from mapctl.formats.units import UNITS
from mapctl.motion import Motion
from mapctl.retarget import RigMap
from mapctl.retarget.doubts import Fit, assess_fit
from mapctl.skeleton import CANONICAL
from priors import checkpoints, weight_sets
from priors.tweener import count_clips
from priors.weight_sets import find_strictest


@dataclass(frozen=True)
class Info(ModelCommand, options.RigOptions):
    """Bundled priors with their cards and licences, scenes, versions, rendering back end, threads; or a clip's rig."""

    tells_licence: ClassVar[bool] = False

    name: Positional[Annotated[str | None, arg(metavar="NAME|CLIP")]] = None
    """A prior whose whole card is printed, as JSON: bundled, a file, or a run folder. Or a clip in
    any format that `mapctl convert` reads, of which rig, joints, unit, axes and length are printed, and whether the fit
    is sure, doubtful or refused, with reasons."""
    out: Annotated[Path | None, arg(aliases=["-o"], metavar="FILE.png")] = None
    """A picture of a clip's rig: its T-pose with both names of each joint, two frames, axes, and what is doubtful."""
    json: bool = False
    """Print JSON instead of tables."""


NOTICE = (
    "The code is MIT. Weights trained on Bandai Namco data are CC BY-NC 4.0, as that data is; the free weights, by"
    " --weights free, may be used for anything."
)


def run(command: Info) -> int:
    """Collect and print."""
    if command.name is not None and is_clip(command.name):
        print_clip(Path(command.name), command)
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


_LISTS = ("joints", "known_by", "unmapped", "doubts", "fit", "skeletons", "animations")

_UNITS = {metres: name for name, metres in UNITS.items()}


def is_clip(name: str) -> bool:
    """Return whether the name is that of a motion file, by its ending."""
    return formats.ending_of(name) in formats.READERS


def print_clip(path: Path, command: Info) -> None:
    """Print a clip's description, and draw it where a picture is asked for.

    RequestError where the rig is not recognised, naming what is missing; what can be told of the clip is printed first.
    """
    picture, as_json = command.out, command.json
    outputs.check_picture(picture, given=path)
    given = inputs.read_rig(command.rig, command)
    motion = inputs.read_motion(path, given, quiet=True)
    try:
        rigmap = retarget.to_canonical(motion, given)[1]
    except RequestError as refusal:
        refused = {"file": str(path), "fit": "refused", "doubts": [str(refusal)], **_describe_file(motion)}
        _print({**refused, "joints": {}, "unmapped": list(motion.skeleton.names)}, as_json=as_json)
        raise
    fit = assess_fit(rigmap, motion)
    _print(describe_clip(path, motion, rigmap, fit), as_json=as_json)
    if picture is not None:
        from scenes.rig_picture import plot_rig

        plot_rig(rigmap, motion, fit, title=path.name, path=picture)


def describe_clip(path: Path, motion: Motion, rigmap: RigMap, fit: Fit) -> dict[str, Any]:
    """Describe a clip by name and value, as `mapctl info` prints it."""
    names = motion.skeleton.names
    joints = {c: None if j is None else names[j] for c, j in zip(CANONICAL.names, rigmap.joint_of, strict=True)}
    found = rigmap.match
    return {
        "file": str(path),
        "rig": rigmap.rig.name,
        "about": rigmap.rig.about,
        "score": round(found.score, 3),
        "fit": fit.verdict,
        "doubts": [doubt.reason for doubt in fit.doubts],
        "sides_exchanged": found.sides_exchanged,
        "rest_pose": rigmap.rest,
        "tpose_from": rigmap.tpose_from,
        "up": rigmap.up,
        "facing": rigmap.facing,
        **_describe_file(motion),
        "joints": joints,
        "known_by": {c: how.value for c, how in found.known_by.items() if joints[c]},
        "unmapped": list(found.unmapped),
    }


def _describe_file(motion: Motion) -> dict[str, Any]:
    """Describe what is known of a clip without its rig."""
    return {
        **({"licence": motion.licence} if motion.licence else {}),
        "metres_per_unit": bvh.unit_of(motion) or 1.0,
        "num_joints": motion.num_joints,
        "frames": motion.num_frames,
        "fps": float(motion.fps),
        "seconds": motion.seconds,
        **(_describe_choices(motion.source) if isinstance(motion.source, CharacterSource) else {}),
    }


def _describe_choices(source: CharacterSource) -> dict[str, Any]:
    """Describe the skeletons and animations of a character's file, which of them were read, and how each is chosen."""
    file, own = source.path.name, source.armature if len(source.armatures) > 1 else ""
    return {
        "skeletons": [
            {"name": name, "read": name == source.armature, "choose": f"{file}#{name}"} for name in source.armatures
        ],
        "animations": [
            {"name": name, "seconds": seconds, "read": name == source.animation, "choose": f"{file}#{own}/{name}"}
            for name, seconds in source.animations.items()
        ],
    }


def _print(described: dict[str, Any], *, as_json: bool) -> None:
    if as_json:
        print(report.to_json(described), end="")
        return
    shown = {key: value for key, value in described.items() if key not in _LISTS}
    shown["fps"] = f"{described['fps']:.6g}"
    shown["seconds"] = f"{described['seconds']:.2f}"
    shown["unit"] = _format_unit(described["metres_per_unit"])
    if "up" in described:
        shown["up"] = f"+{described['up']}" if len(described["up"]) == 1 else described["up"]
    del shown["metres_per_unit"]
    print_table(["clip", ""], [[key.replace("_", " "), str(value)] for key, value in shown.items()])
    for kind in ("skeletons", "animations"):
        rows = [
            [
                one["name"],
                f"{one['seconds']:.2f} s" if "seconds" in one else "",
                "read" if one["read"] else one["choose"],
            ]
            for one in described.get(kind, ())
        ]
        if rows:
            print_table([kind, "", "read, or chosen by"], rows)
    if described["joints"]:
        print_table(["canonical", "joint of the rig"], [[c, own] for c, own in described["joints"].items()])
    print(f"not canonical ({len(described['unmapped'])}): {', '.join(described['unmapped']) or 'none'}")
    print(f"fit: {described['fit']}")
    if described["fit"] == "doubtful":  # why a rig is refused, standard error says
        for reason in described["doubts"]:
            print(f"doubtful: {reason}")
        print(inputs.OVERRULE)


def _format_unit(metres: float) -> str:
    return f"{_UNITS[metres]} ({metres:g} m)" if metres in _UNITS else f"{metres:g} m"
