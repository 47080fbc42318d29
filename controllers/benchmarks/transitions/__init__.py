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
from controllers.benchmarks.transitions.table import ALL_KINDS, DRAWS, LENGTHS, benchmark_transitions

__all__ = [
    "ALL_KINDS",
    "DRAWS",
    "LENGTHS",
    "Energy",
    "Filled",
    "Method",
    "Sampler",
    "benchmark_transitions",
    "draw_retrieved",
    "hold_last_pose",
    "of_density",
    "of_draws",
    "of_inbetweener",
    "of_retrieval",
]
