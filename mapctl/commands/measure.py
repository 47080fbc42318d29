"""`mapctl measure`: the measures of a motion, or of a folder of them, beside those of a reference and of mocap."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from tyro.conf import Positional, arg

from mapctl.commands.shared import options
from mapctl.commands.shared.tables import format_cell, print_table
from mapctl.commands.shared.threads import use_single_thread
from mapctl.errors import CheckpointError, RequestError

if TYPE_CHECKING:
    from mapctl.commands.shared.clip_sets import ClipSet
    from mapctl.curves.curve import Curve
    from mapctl.motion import Motion

_MAX_LINES = 12  # of notes and clips that are left out


@dataclass(frozen=True)
class Measure:
    """Path, feet, jitter and more of a motion, beside a reference clip and mocap's own values.

    All are measured as mocap's values were: on canonical joints with Y up, at 30 frames a second if there are more. Of
    a folder the means over its clips; beside a folder of mocap also whether the two can be told apart. Clips of a
    folder that cannot be measured are left out and listed.
    """

    clip: Positional[Annotated[Path, arg(metavar="CLIP|FOLDER")]]
    """.bvh, .npz or .amc; or a folder, every one of them below it."""
    reference: Annotated[Path | None, arg(metavar="CLIP|FOLDER")] = None
    """Another clip to print beside it; or for a folder another, unseen mocap say: adds realism and diversity."""
    curve: options.MaybeCurve = None
    """What it was to follow: circle:4, a CSV, an SVG (see `mapctl follow --help`)."""
    speed: options.MaybeNumber = None
    """Speed it was asked for, m/s: adds the progress along the curve."""
    metres_per_unit: options.MaybeNumber = None
    """Scale of a CSV or SVG file."""
    prior: options.Name = "locomotion"
    """Whose card has mocap's values."""
    seed: options.Count = 0
    """Of the network that tells two folders apart."""
    json: bool = False
    """Print JSON instead of a table."""

    def run(self) -> int:
        """Measure and print."""
        folders = [path.is_dir() for path in options.collect_paths(self.clip, self.reference)]
        if any(folders):
            self._check_folders(all(folders))
            use_single_thread()
        values = self._measure_folders() if any(folders) else self._measure_clips()
        if self.json:
            from mapctl import report

            print(report.to_json(values), end="")
        else:
            _print_tables(values)
        return 0

    def _measure_clips(self) -> dict[str, Any]:
        from mapctl import metrics

        curve = self._read_curve()
        clip, notes = _load_comparable(self.clip)
        ours = metrics.measure(clip, curve, speed=self.speed)
        reference = {}
        if self.reference is not None:
            other, more = _load_comparable(self.reference)
            reference, notes = metrics.measure(other), notes + more
        return {
            "clip": str(self.clip),
            "measures": ours,
            "reference": reference,
            "mocap": _read_mocap_values(self.prior),
            "notes": notes,
        }

    def _read_curve(self) -> "Curve | None":
        if self.speed is not None and not 0 < self.speed < float("inf"):
            raise RequestError(f"speed must be positive, got {self.speed:g} m/s")
        if self.curve is None and (self.speed is not None or self.metres_per_unit is not None):
            raise RequestError("--speed and --metres-per-unit are about a curve; name it with --curve")
        return None if self.curve is None else options.read_curve(self.curve, self.metres_per_unit)

    def _check_folders(self, alike: bool) -> None:
        options.check_seed(self.seed)
        if not alike:
            raise RequestError(f"{self.clip} and {self.reference}: a folder and a clip; name two of one kind")
        if any(option is not None for option in (self.curve, self.speed, self.metres_per_unit)):
            raise RequestError(f"{self.clip} is a folder; --curve, --speed and --metres-per-unit are for one clip")

    def _measure_folders(self) -> dict[str, Any]:
        from mapctl.commands.shared.clip_sets import ClipSet

        compared = self.reference is not None
        ours = ClipSet.read(self.clip, with_windows=compared)
        reference = ClipSet.read(self.reference, with_windows=True) if self.reference is not None else None
        values = {
            "clip": str(self.clip),
            "clips": len(ours.motions),
            "measures": ours.means,
            "reference": {} if reference is None else reference.means,
            "mocap": _read_mocap_values(self.prior),
            "notes": ours.notes + (() if reference is None else reference.notes),
            "skipped": ours.skipped | ({} if reference is None else reference.skipped),
        }
        return values if reference is None else values | self._compare_folders(ours, reference)

    def _compare_folders(self, ours: "ClipSet", reference: "ClipSet") -> dict[str, Any]:
        from mapctl.commands.shared.clip_sets import compare_realism, compare_variability

        realism = compare_realism(ours, reference, seed=self.seed)
        return {
            "reference_clips": len(reference.motions),
            "realism": asdict(realism),
            "spread": compare_variability(ours, reference),
        }


def _print_tables(values: Mapping[str, Any]) -> None:
    """What there is of measures, realism and spread, each as a table."""
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
        print_table(
            ["spread", "ours", "reference", "ratio"], rows, title="how widely the clips spread (in pieces of 3 s)"
        )
    for line in _shorten([*(f"left out {reason}" for reason in values.get("skipped", {}).values()), *values["notes"]]):
        print(line)


def _shorten(lines: Sequence[str]) -> list[str]:
    """The first of them, and how many more there are."""
    more = len(lines) - _MAX_LINES
    return [*lines[:_MAX_LINES], *([f"and {more} more, which --json lists"] if more > 0 else [])]


def _load_comparable(path: Path) -> "tuple[Motion, list[str]]":
    """A clip as mocap's values were measured, and what could not be made so."""
    from mapctl import formats
    from mapctl.metrics.comparison import make_comparable

    motion, notes = make_comparable(formats.load(path))
    return motion, [f"{path}: {note}" for note in notes]


def _print_realism(realism: Mapping[str, Any]) -> None:
    counts = f"{realism['made_windows']} and {realism['mocap_windows']} windows of one second"
    rows = [
        ["told apart, %", *(100 * realism[name] for name in ("accuracy", "floor_accuracy"))],
        ["Frechet distance", realism["frechet"], realism["floor_frechet"]],
    ]
    columns = ["realism", "ours against the reference", "halves of the reference (floor)"]
    print_table(columns, rows, title=f"{counts}; 50 % cannot be told apart")


def _read_mocap_values(prior: str) -> Mapping[str, Any]:
    """Mocap's values from the prior's card; none where the prior is not there."""
    from mapctl import report
    from priors import checkpoints

    try:
        return report.reference_measures(checkpoints.read_card(checkpoints.locate(prior).with_suffix(".json")).quality)
    except CheckpointError:
        return {}


def _format_range(values: Mapping[str, float] | None) -> str | None:
    if values is None:
        return None
    return f"{format_cell(values['mean'])} ({format_cell(values['p2'])} to {format_cell(values['p98'])})"
