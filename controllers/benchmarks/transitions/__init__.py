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
from controllers.benchmarks.transitions.table import ALL_KINDS, DRAWS, LENGTHS, benchmark_transitions
from controllers.benchmarks.transitions.told import benchmark_told

__all__ = [
    "ALL_KINDS",
    "DRAWS",
    "LENGTHS",
    "Energy",
    "Filled",
    "Method",
    "Sampler",
    "benchmark_over_time",
    "benchmark_told",
    "benchmark_transitions",
    "draw_retrieved",
    "hold_last_pose",
    "of_density",
    "of_draws",
    "of_inbetweener",
    "of_retrieval",
]
