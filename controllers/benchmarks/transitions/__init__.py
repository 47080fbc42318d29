"""Benchmark of transitions between poses."""

from controllers.benchmarks.transitions.methods import (
    Energy,
    Filled,
    Method,
    Sampler,
    draw_retrieved,
    hold_last_pose,
    of_density,
    of_draws,
    of_inbetweener,
    of_retrieval,
)
from controllers.benchmarks.transitions.over_time import benchmark_over_time
from controllers.benchmarks.transitions.partial_keys import benchmark_partial_keys
from controllers.benchmarks.transitions.table import ALL_KINDS, DRAWS, LENGTHS, benchmark_transitions

__all__ = [
    "ALL_KINDS",
    "DRAWS",
    "LENGTHS",
    "Energy",
    "Filled",
    "Method",
    "Sampler",
    "benchmark_over_time",
    "benchmark_partial_keys",
    "benchmark_transitions",
    "draw_retrieved",
    "hold_last_pose",
    "of_density",
    "of_draws",
    "of_inbetweener",
    "of_retrieval",
]
