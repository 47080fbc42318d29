"""`mapctl measure`: the measures of a motion, or of a folder of them, beside those of a reference and of mocap."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from statistics import fmean
from typing import Annotated, Any, ClassVar

import torch
from torch import Tensor
from tyro.conf import Positional, arg

from mapctl import curves, editing, formats, metrics, report, retarget
from mapctl.commands.shared import inputs, options, outputs
from mapctl.commands.shared.command import ModelCommand
from mapctl.errors import CheckpointError, MapctlError, RequestError
from mapctl.metrics import make_comparable, realism
from mapctl.metrics.faults import list_faults
from mapctl.motion import Motion
from mapctl.retarget.rigs import Rig
from priors import checkpoints


@dataclass(frozen=True)
class Measure(ModelCommand, options.RigOptions):
    """Path, feet, jitter and more of a motion, beside a reference clip and mocap's own values.

    Of a clip also its cycle, of a walk or a run one stride, or that it has none; and its faults, the worst first:
    spikes, frozen frames, drop-outs, noise, smoothed spans, and feet that slide, float or penetrate the floor (`mapctl
    denoise --only-faults` repairs them, but for noise and smoothing).
    All are measured as mocap's values were: on canonical joints with Y up, at 30 frames a second if there are more. Of
    a folder the means and the largest values over its clips; beside a folder of mocap also how well a classifier
    separates the two. Clips of a folder that cannot be measured are left out and listed.
    """

    prints_licence: ClassVar[bool] = False

    clip: Positional[Annotated[Path, arg(metavar="CLIP|FOLDER")]]
    """A motion in any format that mapctl reads; or a folder, every one below it."""
    reference: Annotated[Path | None, arg(metavar="CLIP|FOLDER")] = None
    """Another clip to print beside it; or for a folder another, for example unseen mocap: adds realism."""
    curve: options.MaybeCurve = None
    """Curve that it was to follow: circle:4, a CSV, an SVG (see `mapctl follow --help`)."""
    speed: options.MaybeNumber = None
    """Requested speed, m/s: adds the progress along the curve."""
    metres_per_unit: options.MaybeNumber = None
    """Scale of a CSV or SVG file."""
    json: bool = False
    """Print JSON instead of a table."""


_MAX_LINES = 12  # of notes and clips that are left out


SETTINGS = realism.RealismSettings()
"""Settings of the classifier of two folders."""


def run(command: Measure) -> int:
    folders = [path.is_dir() for path in options.collect_paths(command.clip, command.reference)]
    values = _measure_folders(command) if all(folders) else _measure_clips(command, any(folders))
    if command.json:
        print(report.to_json(values), end="")
    else:
        _print_tables(values)
    return 0


def _measure_clips(command: Measure, mixed: bool) -> dict[str, Any]:
    if mixed:
        raise RequestError(f"{command.clip} and {command.reference}: a folder and a clip; name two of one kind")
    if command.speed is not None and not 0 < command.speed < math.inf:
        raise RequestError(f"speed must be positive, got {command.speed:g} m/s")
    if command.curve is None and (command.speed is not None or command.metres_per_unit is not None):
        raise RequestError("--speed and --metres-per-unit are about a curve; name it with --curve")
    curve = None if command.curve is None else curves.read(command.curve, metres_per_unit=command.metres_per_unit)
    rig = inputs.read_rig(command.rig, command)
    whole = inputs.read_motion(command.clip, rig)
    clip, notes = _make_comparable(whole, command.clip, rig)
    ours, reference = metrics.measure(clip, curve, speed=command.speed), {}
    if command.reference is not None:
        other, more = _make_comparable(inputs.read_motion(command.reference, None), command.reference)
        reference, notes = metrics.measure(other), notes + more
    try:
        canonical = retarget.to_canonical(whole, rig)[0]
        cycle = editing.describe_cycle(canonical, editing.find_cycle(canonical))
    except RequestError as error:
        cycle = {"none": str(error).removeprefix("no cycle is found: ")}
    values: dict[str, Any] = {
        "clip": str(command.clip),
        "measures": ours,
        "reference": reference,
        "mocap": _read_mocap_values(),
        "cycle": cycle,
        "notes": notes,
    }
    try:
        faults = list_faults(whole, rig)
    except RequestError:  # of an unknown rig, which the notes name
        return values
    fps = float(whole.fps)
    seconds = [{"start_s": fault.start / fps, "stop_s": fault.stop / fps} for fault in faults]
    return values | {"faults": [vars(fault) | when for fault, when in zip(faults, seconds, strict=True)]}


@dataclass(frozen=True, eq=False)
class _ClipSet:
    """Measured clips of a folder, in the order of their paths."""

    measures: list[dict[str, float]]
    """Measures of each clip."""
    windows: list[Tensor]
    """Windows of each clip, (windows, frames, channels); none unless read with windows."""
    skipped: dict[str, str]
    """Reasons by file that was left out, each a sentence that begins with the file."""
    notes: list[str]
    """Notes on measures that could not be made comparable."""

    def summarise(self, summary: Callable[[Sequence[float]], float]) -> dict[str, float]:
        """Summarise each measure over the clips that can give it; NaN where none can."""
        known = {name: [row[name] for row in self.measures if row[name] == row[name]] for name in self.measures[0]}
        return {name: summary(values) if values else math.nan for name, values in known.items()}

    @staticmethod
    def read(folder: Path, *, with_windows: bool, rig: Rig | None = None) -> "_ClipSet":
        """Read and measure clips of a rig. A file that cannot be read, measured or cut into windows is left out;
        RequestError if none can, and for fewer than a comparison needs."""
        paths = sorted(p for p in folder.rglob("*") if p.suffix.lower() in formats.IN_FOLDERS and p.is_file())
        if not paths:
            raise RequestError(f"{folder}: no {' or '.join(formats.IN_FOLDERS)} file in this folder or below it")
        found = _ClipSet([], [], {}, [])
        with outputs.show_progress(f"reading {folder}") as progress:
            for number, path in enumerate(paths, start=1):
                try:
                    motion, notes = _make_comparable(inputs.read_motion(path, rig), path, rig)
                    windows = [realism.cut_windows(motion)] if with_windows else []
                    found.measures.append(metrics.measure(motion))
                    found.windows.extend(windows)
                    found.notes.extend(notes)
                except MapctlError as error:
                    found.skipped[str(path)] = str(error) if str(error).startswith(str(path)) else f"{path}: {error}"
                if progress is not None:
                    progress(number, len(paths))
        count, first = len(found.measures), next(iter(found.skipped.values()), None)
        if not count:
            raise RequestError(f"{folder}: no clip can be measured; {first}")
        if with_windows and count < SETTINGS.min_clips:
            skipped = "" if first is None else f", and {len(found.skipped)} cannot be measured: {first}"
            raise RequestError(
                f"{folder}: {count} clips; a comparison needs at least {SETTINGS.min_clips} in each folder{skipped}"
                " (without --reference a folder of any size is measured)"
            )
        return found


def _measure_folders(command: Measure) -> dict[str, Any]:
    if any(option is not None for option in (command.curve, command.speed, command.metres_per_unit)):
        raise RequestError(f"{command.clip} is a folder; --curve, --speed and --metres-per-unit are for one clip")
    compared, rig = command.reference is not None, inputs.read_rig(command.rig, command)
    ours = _ClipSet.read(command.clip, with_windows=compared, rig=rig)
    values: dict[str, Any] = {
        "clip": str(command.clip),
        "clips": len(ours.measures),
        "measures": ours.summarise(fmean),
        "largest": ours.summarise(max),
        "reference": {},
        "mocap": _read_mocap_values(),
        "notes": ours.notes,
        "skipped": ours.skipped,
    }
    if command.reference is None:
        return values
    reference = _ClipSet.read(command.reference, with_windows=True)
    generator = torch.Generator().manual_seed(0)
    with outputs.show_progress("comparing") as progress:
        compared = realism.measure_realism(
            ours.windows, reference.windows, generator=generator, settings=SETTINGS, progress=progress
        )
    return values | {
        "reference": reference.summarise(fmean),
        "notes": ours.notes + reference.notes,
        "skipped": ours.skipped | reference.skipped,
        "reference_clips": len(reference.measures),
        "realism": asdict(compared),
    }


def _print_tables(values: Mapping[str, Any]) -> None:
    """Print measures, and realism where it is measured, each as a table."""
    reference, mocap = values["reference"], values["mocap"]
    columns = {"ours": values["measures"], "reference": reference}
    if "largest" in values:
        columns = {"mean": values["measures"], "largest": values["largest"], "mean of the reference": reference}
    rows = [
        [name, *(column.get(name) for column in columns.values()), _format_range(mocap.get(name))]
        for name in values["measures"]
    ]
    title = None if "clips" not in values else f"over {values['clips']} clips"
    if "reference_clips" in values:
        title = f"{title}, and over {values['reference_clips']} of the reference"
    outputs.print_table(["measure", *columns, "mocap (2 to 98 %)"], rows, title=title)
    if "realism" in values:
        _print_realism(values["realism"])
    if "cycle" in values:
        print(_describe_cycle(values["cycle"]))
    if "faults" in values:
        _print_faults(values["faults"])
    lines = [*(f"left out {reason}" for reason in values.get("skipped", {}).values()), *values["notes"]]
    more = [f"and {len(lines) - _MAX_LINES} more, which --json lists"] if len(lines) > _MAX_LINES else []
    print("".join(f"{line}\n" for line in [*lines[:_MAX_LINES], *more]), end="")


def _make_comparable(motion: Motion, path: Path, rig: Rig | None = None) -> tuple[Motion, list[str]]:
    """Convert a clip to the rate and rig of mocap's reference values, and note what could not be converted."""
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
    return f"{about}; {cycle['steps_per_minute']:.0f} steps a minute, stride {cycle['stride_m']:.2f} m"


_FAULT_COLUMNS = {
    "kind": "fault",
    "joint": "joint",
    "start": "from frame",
    "stop": "to",
    "start_s": "from s",
    "stop_s": "to s",
    "amount": "size",
    "unit": "",
}


def _print_faults(faults: Sequence[Mapping[str, Any]]) -> None:
    """Print the worst faults, and noise, which is in all frames, in a line."""
    noisy = [f"{fault['joint']} {fault['amount']:.1f} {fault['unit']}" for fault in faults if fault["kind"] == "noise"]
    if noisy:
        print(f"noise in all frames: {noisy[0]}" + (f", {len(noisy) - 1} more joints less" if len(noisy) > 1 else ""))
    rows = [[fault[key] for key in _FAULT_COLUMNS] for fault in faults if fault["kind"] != "noise"]
    if rows:
        outputs.print_table([*_FAULT_COLUMNS.values()], rows[:_MAX_LINES])
    rest = f", of which --json lists {len(rows) - _MAX_LINES} more" if len(rows) > _MAX_LINES else ""
    print(f"faults: {len(rows) or 'none'}{rest}")


def _print_realism(realism: Mapping[str, Any]) -> None:
    counts = f"{realism['generated_windows']} and {realism['mocap_windows']} windows of one second"
    rows = [
        ["classifier accuracy, %", *(100 * realism[name] for name in ("accuracy", "floor_accuracy"))],
        ["Frechet distance", realism["frechet"], realism["floor_frechet"]],
    ]
    columns = ["realism", "ours against the reference", "halves of the reference (floor)"]
    outputs.print_table(columns, rows, title=f"{counts}; 50 % is chance")


def _read_mocap_values() -> Mapping[str, Any]:
    """Read mocap's values from the card of the bundled prior; none where there is none."""
    try:
        return checkpoints.read_card(checkpoints.locate("locomotion").with_suffix(".json")).quality.get("mocap", {})
    except CheckpointError:
        return {}


def _format_range(values: Mapping[str, float] | None) -> str | None:
    if values is None:
        return None
    mean, low, high = (outputs.format_cell(values[name]) for name in ("mean", "p2", "p98"))
    return f"{mean} ({low} to {high})"
