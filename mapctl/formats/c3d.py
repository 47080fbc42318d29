"""C3D in, by the package ezc3d: labelled positions of markers. C3D is not written.

`find_points` runs in `mapctl.formats.sandbox`, without torch.
"""

import re
from fractions import Fraction
from os import PathLike
from typing import TYPE_CHECKING, Any

import ezc3d
import numpy as np

from mapctl.formats import sandbox
from mapctl.formats.sandbox import Refusal
from mapctl.formats.text import check_ordinary, one_line

if TYPE_CHECKING:
    from mapctl.formats.missing import MissingValues
    from mapctl.motion import Motion


def read(
    path: str | PathLike[str],
    *,
    lossy: bool,
    fps: Fraction | float | None = None,
    markers: str | PathLike[str] | None = None,
) -> "tuple[Motion, MissingValues]":
    """Read markers in a sandbox and fit a body to them, as `positions.read` does; the frame rate is the file's."""
    from mapctl.formats import marker_fit, positions

    check_ordinary(path)
    return marker_fit.fit(path, positions.build_capture(path, *sandbox.call(find_points, path)), markers)


def find_points(path: str) -> tuple[list[str], np.ndarray, float, str, str | None]:
    """Read labels, positions (frames, points, 3), frames per second, unit, and the axis that points up where the
    file states it. Points that are model outputs in other units, as angles, are left out. Refusal gives the reason."""
    try:
        file = ezc3d.c3d(path)
    except MemoryError:
        raise
    except Exception as error:  # ezc3d raises errors of all kinds
        why = re.split(r"\. |, please|: iostream", one_line(error))[0]  # the rest is advice to programmers
        why = "its parameters are broken" if "bad_alloc" in why else why
        raise Refusal(f"is no C3D that can be read: {why}") from None
    points, about = file["data"]["points"], file["parameters"]["POINT"]

    def state(name: str) -> list[Any]:
        return list(about[name]["value"]) if name in about else []

    def gather(name: str) -> list[str]:  # more than 255 labels are in several parameters
        return [str(text).strip() for n in ("", *range(2, 100)) for text in state(f"{name}{n}")]

    labels, described = gather("LABELS")[: points.shape[1]], gather("DESCRIPTIONS")
    labels += [""] * (points.shape[1] - len(labels))
    outputs = {name for group in state("TYPE_GROUPS") for name in state(group)}
    # names of four letters may be cut: of several that are the same the descriptions may tell which is which
    names = [
        described[n] if label and labels.count(label) > 1 and n < len(described) and described[n] else label
        for n, label in enumerate(labels)
    ]
    kept = [n for n, label in enumerate(labels) if label and label not in outputs]
    positions = points[:3, kept].T.astype(np.float64)
    positions[file["data"]["meta_points"]["residuals"][0].T[:, kept] < 0] = np.nan
    unit, up = (next(iter(state(name)), "") for name in ("UNITS", "Y_SCREEN"))
    rate = float(next(iter(state("RATE")), 0.0))
    return [names[n] for n in kept], positions, rate, str(unit), str(up) if str(up)[1:] in ("X", "Y", "Z") else None
