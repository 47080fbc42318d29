"""Plots of motions over time, by matplotlib."""

from collections.abc import Iterator
from contextlib import contextmanager
from os import PathLike
from typing import Any

from mapctl.errors import RequestError
from mapctl.formats.atomic import atomic_path


@contextmanager
def open_plots(
    path: str | PathLike[str],
    count: int,
    *,
    inches: tuple[float, float],
    dpi: int,
    across: int = 1,
    share_x: bool = True,
) -> Iterator[Any]:
    """Yield the axes of plots below each other over one time axis, (count,), or of rows of several, (count, across),
    each over its own unless they `share_x`; they are written as a PNG at the end.

    RequestError where matplotlib is not installed.
    """
    try:
        from matplotlib.figure import Figure
    except ImportError as error:
        raise RequestError(f"plots need matplotlib ({error}): pip install 'mapctl[render]'") from error
    figure = Figure(figsize=inches, layout="constrained")
    yield figure.subplots(count, across, sharex=share_x)
    with atomic_path(path) as scratch:
        figure.savefig(scratch, format="png", dpi=dpi)
