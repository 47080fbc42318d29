"""Rows of the benchmarks' tables."""

from collections.abc import Sequence
from typing import Any

import numpy as np

Row = dict[str, Any]
"""Figures by column."""


def average_rows(rows: Sequence[Row], columns: Sequence[str] | None = None, *, worst: Sequence[str] = ()) -> Row:
    """Compute the mean of each column, of those of the first row if none are named, and the largest of those that are
    `worst`; NaN does not count."""
    means = {}
    for name in rows[0] if columns is None else columns:
        column = np.array([row[name] for row in rows])
        summarise = np.nanmax if name in worst else np.nanmean
        means[name] = float(summarise(column)) if np.isfinite(column).any() else float("nan")
    return means
