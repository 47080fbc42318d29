"""`mapctl bench gaps`: how far answers for gaps are from the truth."""

from controllers.benchmarks.gaps import benchmark_gaps
from mapctl.commands.bench import Gaps
from mapctl.commands.bench.tween import compare_inbetweeners


def run(table: Gaps) -> int:
    """Measure and print."""
    return compare_inbetweeners(table, "gaps", benchmark_gaps)
