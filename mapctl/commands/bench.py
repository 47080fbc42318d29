"""`mapctl bench`: cost of the solver, and the ablation of its choices, on this machine."""

from dataclasses import dataclass
from typing import Annotated, Literal

from tyro.conf import Positional, arg

from mapctl.commands import options
from mapctl.commands.tables import print_records
from mapctl.commands.threads import compute_on_one


@dataclass(frozen=True)
class Bench:
    """Cost of the solver on this machine, or the ablation of its choices."""

    what: Positional[Annotated[Literal["speed", "ablation", "free-run"], arg(metavar="speed|ablation|free-run")]] = (
        "speed"
    )
    """`speed`: milliseconds a frame, fast path and reference; `ablation`: starts and unknowns compared;
    `free-run`: 8 random motions of 10,000 frames beside the training data."""
    prior: options.Name = "locomotion"
    """A bundled prior, or the file or run folder of a trained one."""
    json: bool = False
    """Print JSON instead of a table."""

    def run(self) -> int:
        """Measure and print."""
        compute_on_one()
        import priors
        from controllers import bench
        from mapctl import report

        measure = {"speed": bench.speed, "ablation": bench.ablation, "free-run": bench.free_run}[self.what]
        rows = measure(priors.load(self.prior))
        if self.json:
            print(report.as_json({"bench": self.what, "versions": report.versions(), "rows": rows}), end="")
        else:
            print_records(rows, title=f"{self.what}, one thread")
        return 0
