"""Clips and table rows that several benchmarks share."""
