"""Clips, corruptions and table rows that several benchmarks share."""
