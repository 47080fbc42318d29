"""`mapctl info`: what is installed: priors and their cards, scenes, versions, rendering, threads; or what a clip is."""

import os
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any, ClassVar

import torch
from tyro.conf import Positional, arg

import scenes
from mapctl import formats, report, retarget
from mapctl.commands.shared import inputs, options, outputs
from mapctl.commands.shared.command import ModelCommand
from mapctl.errors import RequestError
from mapctl.features import PRIOR_FPS
from mapctl.formats.character import CharacterSource
from mapctl.formats.marker_fit import MarkerFit
from mapctl.formats.units import UNITS, FileUnit
from mapctl.retarget.doubts import assess_fit
from mapctl.skeleton import CANONICAL
from priors import checkpoints, weight_sets
from priors.tweener import count_clips
from priors.weight_sets import find_strictest


@dataclass(frozen=True)
class Info(ModelCommand, options.RigOptions):
    """Bundled priors with their cards and licences, scenes, versions, rendering back end, threads; or a clip's rig."""

    prints_licence: ClassVar[bool] = False

    name: Positional[Annotated[str | None, arg(metavar="NAME|CLIP")]] = None
    """A prior whose whole card is printed, as JSON: bundled, a file, or a run folder. Or a clip in
    any format that `mapctl convert` reads, of which rig, joints, unit, axes and length are printed, and whether the fit
    is sure, doubtful or refused, with reasons."""
    out: Annotated[Path | None, arg(aliases=["-o"], metavar="FILE.png")] = None
    """A picture of a clip's rig: its T-pose with both names of each joint, two frames, axes, and what is doubtful."""
    markers: options.MaybeMarkers = None
    json: bool = False
    """Print JSON instead of tables."""


NOTICE = (
    "The code is MIT. Weights trained on Bandai Namco data are CC BY-NC 4.0, as that data is; the free weights, by"
    " --weights free, may be used for anything."
)
_MAX_MARKERS = 3
_UNITS = {metres: name for name, metres in UNITS.items()}


def run(command: Info) -> int:
    if command.name is not None and formats.ending_of(command.name) in formats.READERS:
        _print_clip(Path(command.name), command)
    elif command.out is not None:
        raise RequestError("--out is a picture of a clip's rig: mapctl info CLIP -o FILE.png")
    elif command.rig is not None or command.unit is not None or command.up is not None:
        raise RequestError("--rig, --unit and --up are of a clip: mapctl info CLIP --rig PRESET|FILE.toml|CLIP")
    elif command.name is not None:
        print(report.to_json(_read_card(command.name)), end="")
    else:
        rows = {weights: _list_models(weights) for weights in weight_sets.SETS}
        current = weight_sets.find_current_set()
        sets = {
            name: {
                "models": [row["name"] for row in models],
                "megabytes": sum(row["megabytes"] for row in models),
                "licence": find_strictest(row["licence"] for row in models),
            }
            for name, models in rows.items()
        }
        found = {
            "priors": [row for models in rows.values() for row in models],
            "weights": {"in_force": current, **sets},
            "installation": _describe_installation(),
            "notice": NOTICE,
        }
        if command.json:
            print(report.to_json(found), end="")
        else:
            _print_tables(found, sets, current)
    return 0


def _read_card(name: str) -> dict[str, Any]:
    """Read the whole card of a prior, and its path; classes of motion without their vectors, with how many clips each
    is of. CheckpointError if there is none."""
    path = checkpoints.locate(name)
    card = checkpoints.read_card(path.with_suffix(".json"))
    return {"file": str(path), **vars(card), "data": count_clips(card.data)}


def _list_models(weights: str) -> list[dict[str, Any]]:
    """List the bundled models of a set in short; those of the default set by their bare names."""
    rows = []
    for name in weight_sets.list_models(weights):
        card = _read_card(f"{weights}/{name}")
        rows.append(
            {
                "name": name if weights == weight_sets.SETS[0] else f"{weights}/{name}",
                "weights": weights,
                **{key: card[key] for key in ("kind", "licence", "abilities", "config")},
                "data": {key: int(card["data"][key]) for key in ("clips", "frames") if key in card["data"]},
                "megabytes": Path(card["file"]).stat().st_size / 1e6,
            }
        )
    return rows


def _describe_installation() -> dict[str, Any]:
    """Describe versions, scenes, rendering back end, threads and cores."""
    return {
        **report.package_versions(),
        "threads of a solve": 1,
        "threads of torch": torch.get_num_threads(),
        "cores": os.cpu_count(),
        "GPU": torch.cuda.get_device_name() if torch.cuda.is_available() else "none",
        "rendering": scenes.back_end(),
        "scenes": ", ".join(scenes.list_scenes()),
    }


def _print_tables(found: Mapping[str, Any], sets: Mapping[str, Any], current: str) -> None:
    rows = []
    for row in found["priors"]:
        limits, minutes = row["abilities"], row["data"].get("frames", 0) / PRIOR_FPS / 60
        speeds = f"{limits['slowest']:.1f} to {limits['fastest']:.1f} m/s" if limits else "-"
        data = f"{row['data']['clips']:,} clips, {minutes:,.0f} min" if minutes else "-"
        rows.append([row["name"], row["kind"], f"{row['megabytes']:.1f} MB", speeds, data, row["licence"]])
    columns = ["prior", "kind", "size", "speeds", "data", "licence of the weights"]
    outputs.print_table(columns, rows or [["none is bundled", *[None] * (len(columns) - 1)]])
    rows = []
    for name, one in sets.items():
        count = len(one["models"])
        about = [str(count), f"{one['megabytes']:.1f} MB", one["licence"]] if count else ["none is bundled", "-", "-"]
        rows.append([f"{name} (in force)" if name == current else name, *about])
    outputs.print_table(["weights", "models", "size", "licence"], rows)
    outputs.print_table(["installation", ""], [[name, str(value)] for name, value in found["installation"].items()])
    print(NOTICE)


def _print_clip(path: Path, command: Info) -> None:
    """Print a clip's description, and draw it where a picture is requested.

    RequestError where the rig is not recognised, naming what is missing; what can be found of the clip is printed
    first.
    """
    picture = command.out
    if picture is not None:
        if picture.suffix.lower() != ".png":
            raise RequestError(f"--out writes .png, not {picture.suffix or 'a file without ending'}")
        outputs.require_render("matplotlib")
        outputs.check_files([picture], given=[path])
    given = inputs.read_rig(command.rig, command)
    motion = inputs.read_motion(path, given, markers=command.markers, quiet=True)
    names = motion.skeleton.names
    about: dict[str, Any] = {"licence": motion.licence} if motion.licence else {}
    about |= {
        "metres_per_unit": motion.source.metres_per_unit if isinstance(motion.source, FileUnit) else 1.0,
        "num_joints": motion.num_joints,
        "frames": motion.num_frames,
        "fps": float(motion.fps),
        "seconds": motion.seconds,
    }
    if isinstance(motion.source, CharacterSource):
        about |= _describe_choices(motion.source)
    if isinstance(motion.source, MarkerFit):
        about["markers"] = asdict(motion.source)
    try:
        rigmap = retarget.to_canonical(motion, given)[1]
    except RequestError as refusal:
        refused = {"file": str(path), "fit": "refused", "doubts": [str(refusal)], **about}
        _print({**refused, "joints": {}, "unmapped": list(names)}, as_json=command.json)
        raise
    fit, found = assess_fit(rigmap, motion), rigmap.match
    joints = {c: None if j is None else names[j] for c, j in zip(CANONICAL.names, rigmap.joint_of, strict=True)}
    described = {
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
        **about,
        "joints": joints,
        "known_by": {c: how.value for c, how in found.known_by.items() if joints[c]},
        "unmapped": list(found.unmapped),
    }
    _print(described, as_json=command.json)
    if picture is not None:
        from scenes.rig_picture import plot_rig

        plot_rig(rigmap, motion, fit, title=path.name, path=picture)


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


def _print_markers(fit: Mapping[str, Any]) -> None:
    """Print how far the fitted body is from the markers."""
    frame, most = fit["worst_frame"]
    worst = sorted(fit["residuals"], key=lambda label: -fit["residuals"][label])[:_MAX_MARKERS]
    named = ", ".join(f"{label} {100 * fit['residuals'][label]:.1f}" for label in worst)
    print(f"markers: {len(fit['residuals'])} are {100 * fit['mean']:.2f} cm from the body on average, most {named}")
    print(f"worst frame: {frame}, {100 * most:.1f} cm on average")
    print(f"not used ({len(fit['unused'])}): {', '.join(fit['unused']) or 'none'}")


def _print(described: dict[str, Any], *, as_json: bool) -> None:
    if as_json:
        print(report.to_json(described), end="")
        return
    lists = ("markers", "joints", "known_by", "unmapped", "doubts", "fit", "skeletons", "animations", "metres_per_unit")
    shown, metres = {key: value for key, value in described.items() if key not in lists}, described["metres_per_unit"]
    shown["fps"], shown["seconds"] = f"{described['fps']:.6g}", f"{described['seconds']:.2f}"
    shown["unit"] = f"{_UNITS[metres]} ({metres:g} m)" if metres in _UNITS else f"{metres:g} m"
    if len(described.get("up", "")) == 1:
        shown["up"] = f"+{described['up']}"
    outputs.print_table(["clip", ""], [[key.replace("_", " "), str(value)] for key, value in shown.items()])
    for kind in ("skeletons", "animations"):
        if choices := described.get(kind):
            rows = []
            for one in choices:
                seconds = f"{one['seconds']:.2f} s" if "seconds" in one else ""
                rows.append([one["name"], seconds, "read" if one["read"] else one["choose"]])
            outputs.print_table([kind, "", "read, or chosen by"], rows)
    if fit := described.get("markers"):
        _print_markers(fit)
    if described["joints"]:
        outputs.print_table(["canonical", "joint of the rig"], [[c, own] for c, own in described["joints"].items()])
    print(f"not canonical ({len(described['unmapped'])}): {', '.join(described['unmapped']) or 'none'}")
    print(f"fit: {described['fit']}")
    if described["fit"] == "doubtful":  # the reason why a rig is refused is on standard error
        for reason in described["doubts"]:
            print(f"doubtful: {reason}")
        print(inputs.OVERRULE)
