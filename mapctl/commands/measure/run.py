"""`mapctl measure`: the measures of a motion, or of a folder of them, beside those of a reference and of mocap."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from mapctl import editing, metrics, report, retarget
from mapctl.commands.measure import Measure
from mapctl.commands.measure.clip_sets import ClipSet, compare_variability, train_judges
from mapctl.commands.shared import inputs, options
from mapctl.commands.shared.tables import format_cell, print_table
from mapctl.curves.curve import Curve
from mapctl.errors import CheckpointError, RequestError
from mapctl.metrics.comparison import make_comparable
from mapctl.motion import Motion
from mapctl.retarget.rigs import Rig
from priors import checkpoints

_MAX_LINES = 12  # of notes and clips that are left out


def run(command: Measure) -> int:
    """Measure and print."""
    folders = [path.is_dir() for path in options.collect_paths(command.clip, command.reference)]
    if any(folders):
        _check_folders(command, all(folders))
    values = _measure_folders(command) if any(folders) else _measure_clips(command)
    if command.json:
        print(report.to_json(values), end="")
    else:
        _print_tables(values)
    return 0


def _measure_clips(command: Measure) -> dict[str, Any]:
    curve = _read_curve(command)
    rig = inputs.read_rig(command.rig, command)
    whole = inputs.read_motion(command.clip, rig)
    clip, notes = _make_comparable(whole, command.clip, rig)
    ours = metrics.measure(clip, curve, speed=command.speed)
    reference = {}
    if command.reference is not None:
        other, more = _make_comparable(inputs.read_motion(command.reference, None), command.reference)
        reference, notes = metrics.measure(other), notes + more
    return {
        "clip": str(command.clip),
        "measures": ours,
        "reference": reference,
        "mocap": _read_mocap_values(),
        "cycle": _measure_cycle(whole, rig),
        "notes": notes,
    }


def _measure_cycle(motion: Motion, rig: Rig | None) -> dict[str, Any]:
    """Describe the cycle of a motion of any rig, at its own rate; else say why there is none."""
    try:
        canonical = retarget.to_canonical(motion, rig)[0]
        return editing.describe_cycle(canonical, editing.find_cycle(canonical))
    except RequestError as error:
        return {"none": str(error).removeprefix("no cycle is found: ")}


def _read_curve(command: Measure) -> Curve | None:
    if command.speed is not None and not 0 < command.speed < float("inf"):
        raise RequestError(f"speed must be positive, got {command.speed:g} m/s")
    if command.curve is None and (command.speed is not None or command.metres_per_unit is not None):
        raise RequestError("--speed and --metres-per-unit are about a curve; name it with --curve")
    return None if command.curve is None else inputs.read_curve(command.curve, command.metres_per_unit)


def _check_folders(command: Measure, alike: bool) -> None:
    if not alike:
        raise RequestError(f"{command.clip} and {command.reference}: a folder and a clip; name two of one kind")
    if any(option is not None for option in (command.curve, command.speed, command.metres_per_unit)):
        raise RequestError(f"{command.clip} is a folder; --curve, --speed and --metres-per-unit are for one clip")


def _measure_folders(command: Measure) -> dict[str, Any]:
    compared = command.reference is not None
    ours = ClipSet.read(command.clip, with_windows=compared, rig=inputs.read_rig(command.rig, command))
    reference = ClipSet.read(command.reference, with_windows=True) if command.reference is not None else None
    values = {
        "clip": str(command.clip),
        "clips": len(ours.motions),
        "measures": ours.means,
        "reference": {} if reference is None else reference.means,
        "mocap": _read_mocap_values(),
        "notes": ours.notes + (() if reference is None else reference.notes),
        "skipped": ours.skipped | ({} if reference is None else reference.skipped),
    }
    return values if reference is None else values | _compare_folders(command, ours, reference)


def _compare_folders(command: Measure, ours: ClipSet, reference: ClipSet) -> dict[str, Any]:
    judges = train_judges(ours, reference)
    return {
        "reference_clips": len(reference.motions),
        "realism": asdict(judges.summarise()),
        "spread": compare_variability(ours, reference),
    }


def _print_tables(values: Mapping[str, Any]) -> None:
    """Print measures, and realism and spread where there are any, each as a table."""
    reference, mocap = values["reference"], values["mocap"]
    rows = [
        [name, value, reference.get(name), _format_range(mocap.get(name))] for name, value in values["measures"].items()
    ]
    title = None if "clips" not in values else f"means over {values['clips']} clips"
    if "reference_clips" in values:
        title = f"{title}, and over {values['reference_clips']} of the reference"
    print_table(["measure", "ours", "reference", "mocap (2 to 98 %)"], rows, title=title)
    if "realism" in values:
        _print_realism(values["realism"])
        rows = [[name, *row.values()] for name, row in values["spread"].items()]
        title = "how widely the clips spread (in pieces of 3 s)"
        print_table(["spread", "ours", "reference", "ratio"], rows, title=title)
    if "cycle" in values:
        print(_describe_cycle(values["cycle"]))
    for line in _shorten([*(f"left out {reason}" for reason in values.get("skipped", {}).values()), *values["notes"]]):
        print(line)


def _shorten(lines: Sequence[str]) -> list[str]:
    """Shorten a list of lines to the first ones and the number of the others."""
    more = len(lines) - _MAX_LINES
    return [*lines[:_MAX_LINES], *([f"and {more} more, which --json lists"] if more > 0 else [])]


def _make_comparable(motion: Motion, path: Path, rig: Rig | None = None) -> tuple[Motion, list[str]]:
    """Make a clip as mocap's values were measured, and note what could not be made so."""
    comparable, notes = make_comparable(motion, rig)
    return comparable, [f"{path}: {note}" for note in notes]


def _describe_cycle(cycle: Mapping[str, Any]) -> str:
    if "none" in cycle:
        return f"cycle: none, {cycle['none']}"
    about = (
        f"cycle: frames {cycle['start']}:{cycle['stop']}, {cycle['frames']} frames, {cycle['seconds']:.2f} s, with"
        f" ends {cycle['mismatch_cm']:.1f} cm apart"
    )
    if not cycle["gait"]:
        return about
    return (
        f"{about}; {cycle['steps_per_minute']:.0f} steps a minute, stride {cycle['stride_m']:.2f} m; right foot"
        f" {cycle['right_after_left']:.2f} of a cycle after the left, mirrored {cycle['asymmetry_cm']:.1f} cm off"
    )


def _print_realism(realism: Mapping[str, Any]) -> None:
    counts = f"{realism['made_windows']} and {realism['mocap_windows']} windows of one second"
    rows = [
        ["told apart, %", *(100 * realism[name] for name in ("accuracy", "floor_accuracy"))],
        ["Frechet distance", realism["frechet"], realism["floor_frechet"]],
    ]
    columns = ["realism", "ours against the reference", "halves of the reference (floor)"]
    print_table(columns, rows, title=f"{counts}; 50 % cannot be told apart")


def _read_mocap_values() -> Mapping[str, Any]:
    """Read mocap's values from the card of the bundled prior; none where there is none."""
    try:
        return report.reference_measures(
            checkpoints.read_card(checkpoints.locate("locomotion").with_suffix(".json")).quality
        )
    except CheckpointError:
        return {}


def _format_range(values: Mapping[str, float] | None) -> str | None:
    if values is None:
        return None
    return f"{format_cell(values['mean'])} ({format_cell(values['p2'])} to {format_cell(values['p98'])})"
