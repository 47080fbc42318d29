"""Shared by the scripts of this folder: clips of any folder and rig, errors in centimetres, a Markdown table.

Each script is run as `python tests/benchmarks/NAME.py --clips FOLDER... [--count N] [--model NAME] [--seed N]` and
prints one table. A folder is a circle: it has its own rows. Of a folder that the model was trained on, the clips that
were held out are taken alone.
"""

import argparse
import os
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import date
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

sys.path.insert(0, str(Path(__file__).parents[1]))  # for `corruptions`

import mapctl
from mapctl import retarget
from mapctl.errors import MapctlError
from mapctl.features import PRIOR_FPS
from mapctl.motion import Motion
from mapctl.skeleton import CANONICAL, leg_length
from priors import checkpoints

ENDINGS = (".bvh", ".fbx", ".glb", ".vrm", ".usd", ".amc", ".npz")
TOLERANCE = 1.05, 0.15  # ratio and centimetres within which an error is not worse than another

Row = Mapping[str, object]


@dataclass(frozen=True, eq=False)
class Clip:
    """A clip, or a piece from its middle."""

    name: str
    motion: Motion


@dataclass
class Circle:
    """Clips of a folder, and how many of those that were tried could not be used."""

    name: str
    clips: list[Clip] = field(default_factory=list)
    skipped: int = 0


def parse(doc: str | None, words: Sequence[str] | None, *, count: int, model: str, **options) -> argparse.Namespace:
    """Parse the options that all scripts share, and those named: a type (text, number) by its default, or choices."""
    parser = argparse.ArgumentParser(description=doc, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--clips", nargs="+", type=Path, required=True, metavar="FOLDER", help="folders of motion")
    parser.add_argument("--count", type=int, default=count, help="clips of each folder, evenly spaced")
    parser.add_argument("--model", default=model, help="a bundled model, or the file or run folder of a trained one")
    parser.add_argument("--seed", type=int, default=0)
    for name, default in options.items():
        kind = {"action": "store_true"} if default is False else {"type": type(default), "default": default}
        parser.add_argument(f"--{name}", **kind)
    return parser.parse_args(words)


def load_circles(
    given: argparse.Namespace, *, shortest: float, longest: float, canonical: bool = False, model: str = ""
) -> list[Circle]:
    """Load the clips of each folder: pieces of at most `longest` seconds from the middle; shorter ones than `shortest`
    and unreadable ones are skipped. `canonical`: on canonical joints and bones at the rate of the priors."""
    return [_load_circle(folder, given.count, shortest, longest, canonical, model) for folder in given.clips]


def _load_circle(folder: Path, count: int, shortest: float, longest: float, canonical: bool, model: str) -> Circle:
    files = list_files(folder, model)
    circle = Circle(folder.parent.name if folder.name == "data" else folder.name)
    for file in files[:: max(1, -(-len(files) // count))]:
        try:
            motion = mapctl.load(file)
            motion = motion.slice(1, motion.num_frames)  # many captures begin with a T-pose
            if motion.seconds < shortest:
                raise MapctlError("too short")
            frames = min(motion.num_frames, round(longest * float(motion.fps)))
            start = (motion.num_frames - frames) // 2
            motion = motion.slice(start, start + frames)
            circle.clips.append(Clip(file.stem, to_canonical_bones(motion) if canonical else motion))
        except MapctlError:
            circle.skipped += 1
    return circle


def list_files(folder: Path, model: str) -> list[Path]:
    """List motion files below a folder in order; of a folder that holds test clips of a model, these alone."""
    files = sorted(file for file in folder.rglob("*") if file.suffix.lower() in ENDINGS)
    if not model:
        return files
    card = checkpoints.read_card(checkpoints.locate(model).with_suffix(".json"))
    kept = {Path(name).name for name in card.data.get("held_out", {}).get("test", ())}
    return [file for file in files if file.name in kept] or files


def to_canonical_bones(motion: Motion) -> Motion:
    """Convert a motion to canonical joints and bones at the rate of the priors, its path scaled by leg length."""
    motion = retarget.to_canonical(motion)[0].resample(PRIOR_FPS)
    scale = leg_length(motion.skeleton) / leg_length(CANONICAL)
    return replace(motion, skeleton=CANONICAL, root_position=motion.root_position / scale)


def measure_error(truth: Motion, other: Motion, frames: slice = slice(None)) -> float:
    """Measure the mean distance of joints, cm."""
    return 100 * float((truth.joint_positions() - other.joint_positions())[frames].norm(dim=-1).mean())


def seeded(*numbers: int) -> torch.Generator:
    """Return a generator that is seeded by numbers."""
    return torch.Generator().manual_seed(sum(1_000_003**position * number for position, number in enumerate(numbers)))


def map_motion(motion: Motion, change: Callable[[Tensor], Float[Tensor, "frames *values"]]) -> Motion:
    """Return the motion with root, rotations (then normalised) and moving offsets changed as functions of time."""
    quats = change(mapctl.rotations.make_sign_continuous(motion.local_quat_xyzw))
    return replace(
        motion,
        root_position=change(motion.root_position),
        local_quat_xyzw=torch.nn.functional.normalize(quats, dim=-1),
        moving_offsets={joint: change(values) for joint, values in motion.moving_offsets.items()},
    )


def compare_methods(
    circles: Sequence[Circle],
    measure: Callable[[Motion, torch.Generator], Mapping[str, Mapping[str, float]]],
    *,
    seed: int,
    simple: str,
    unit: str = "cm",
) -> list[Row]:
    """Measure errors of each clip by case and method, and summarise them: mean, worst clip, and clips in which the
    method is worse than the `simple` one. Clips that raise a MapctlError are skipped."""
    rows: list[Row] = []
    for circle in circles:
        cases: dict[str, list[tuple[str, Mapping[str, float]]]] = {}
        for number, clip in enumerate(circle.clips):
            try:
                for case, errors in measure(clip.motion, seeded(seed, number)).items():
                    cases.setdefault(case, []).append((clip.name, errors))
            except MapctlError:
                circle.skipped += 1
        for case, found in cases.items():
            for method in found[0][1]:
                worst, name = max((errors[method], name) for name, errors in found)
                more = [errors[method] > TOLERANCE[0] * errors[simple] + TOLERANCE[1] for _, errors in found]
                rows.append(
                    {
                        "clips of": circle.name,
                        "case": case,
                        "method": method,
                        "clips": len(found),
                        f"mean, {unit}": average(errors[method] for _, errors in found),
                        f"worst, {unit}": worst,
                        "worst clip": name,
                        f"worse than {simple}": "" if method == simple else f"{sum(more) / len(more):.0%}",
                    }
                )
    return rows


def average(values: Iterator[float] | Sequence[float]) -> float:
    """Return the mean of the numbers among values; NaN where there is none."""
    known = [value for value in values if value == value]
    return sum(known) / len(known) if known else float("nan")


def print_table(rows: Sequence[Row], circles: Sequence[Circle]) -> None:
    """Print rows as a Markdown table; below it how many clips of each folder were used and skipped, and provenance."""
    columns = list(dict.fromkeys(name for row in rows for name in row))
    lines = [columns, ["---"] * len(columns), *([_format(row.get(name)) for name in columns] for row in rows)]
    print("\n".join(f"| {' | '.join(line)} |" for line in lines))
    used = (f"{circle.name} {len(circle.clips)} clips, {circle.skipped} skipped" for circle in circles)
    asked = " ".join([Path(sys.argv[0]).name, *(Path(word).name for word in sys.argv[1:])])
    find_commit = ["git", "-C", str(Path(__file__).parent), "rev-parse", "--short", "HEAD"]
    commit = subprocess.run(find_commit, capture_output=True, text=True, check=False).stdout.strip()
    print(f"\n{'; '.join(used)}.")
    print(f"`{asked}`, {date.today()}, commit {commit}, {os.cpu_count()} cores, no GPU.")


def _format(value: object) -> str:
    if value is None or value != value:
        return ""
    if isinstance(value, float):
        return f"{value:.0f}" if abs(value) >= 100 else f"{value:.3g}"
    return str(value)
