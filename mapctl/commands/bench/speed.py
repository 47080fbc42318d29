"""`mapctl bench speed`: what the solver costs."""

from pathlib import Path

import mapctl
import priors
from controllers.benchmarks.solver import benchmark_speed
from mapctl.commands.bench import Speed
from mapctl.commands.bench.output import print_rows
from mapctl.commands.bench.versions.alternate import time_versions
from mapctl.errors import RequestError


def run(table: Speed) -> int:
    """Measure and print."""
    if table.beside is not None:
        if table.turns < 1:
            raise RequestError(f"--turns must be 1 or more, got {table.turns}")
        ours = Path(mapctl.__file__).parent.parent
        return print_rows(table, time_versions(ours, table.beside, turns=table.turns))
    prior = priors.load(table.prior)
    return print_rows(table, benchmark_speed(prior, prior.without_kernels()))
