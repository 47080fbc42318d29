"""`mapctl measure`: the measures of a motion beside those of another clip and of mocap."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from tyro.conf import Positional

from mapctl.commands import options
from mapctl.commands.tables import cell, print_table
from mapctl.errors import CheckpointError, RequestError

if TYPE_CHECKING:
    from mapctl.curve import Curve


@dataclass(frozen=True)
class Measure:
    """Path, feet, jitter and more of a motion, beside a reference clip and mocap's own values."""

    clip: Positional[options.File]
    """.bvh or .npz."""
    reference: options.MaybeFile = None
    """Another clip to print beside it."""
    curve: options.MaybeCurve = None
    """What it was to follow: circle:4, a CSV, an SVG (see `mapctl follow --help`)."""
    speed: options.MaybeNumber = None
    """Speed it was asked for, m/s: adds the progress along the curve."""
    metres_per_unit: options.MaybeNumber = None
    """Scale of a CSV or SVG file."""
    prior: options.Name = "locomotion"
    """Whose card has mocap's values."""
    json: bool = False
    """Print JSON instead of a table."""

    def run(self) -> int:
        """Measure and print."""
        from mapctl import formats, metrics, report

        curve = self._curve()
        ours = metrics.measure(formats.load(self.clip), curve, speed=self.speed)
        reference = {} if self.reference is None else metrics.measure(formats.load(self.reference))
        mocap = _mocap(self.prior)
        if self.json:
            values = {"clip": str(self.clip), "measures": ours, "reference": reference, "mocap": mocap}
            print(report.as_json(values), end="")
        else:
            rows = [[name, value, reference.get(name), _spread(mocap.get(name))] for name, value in ours.items()]
            print_table(["measure", "ours", "reference", "mocap (2 to 98 %)"], rows)
        return 0

    def _curve(self) -> "Curve | None":
        if self.speed is not None and not 0 < self.speed < float("inf"):
            raise RequestError(f"speed must be positive, got {self.speed:g} m/s")
        if self.curve is None and (self.speed is not None or self.metres_per_unit is not None):
            raise RequestError("--speed and --metres-per-unit are about a curve; name it with --curve")
        return None if self.curve is None else options.read_curve(self.curve, self.metres_per_unit)


def _mocap(prior: str) -> Mapping[str, Any]:
    """Mocap's values from the prior's card; none where the prior is not there."""
    from mapctl import report
    from priors import checkpoints

    try:
        return report.mocap_values(checkpoints.read_card(checkpoints.locate(prior).with_suffix(".json")).quality)
    except CheckpointError:
        return {}


def _spread(values: Mapping[str, float] | None) -> str | None:
    if values is None:
        return None
    return f"{cell(values['mean'])} ({cell(values['p2'])} to {cell(values['p98'])})"
