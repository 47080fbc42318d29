"""Reports: the request, the result and its cost, as JSON that every parser reads."""

import json
import math
import os
import platform
from collections.abc import Mapping, Sequence
from importlib import metadata
from os import PathLike
from typing import Any

import numpy as np
import torch

from mapctl.formats.atomic import write_text
from mapctl.problem.solution import Solution, WindowRecord
from mapctl.version import __version__

try:
    import resource
except ImportError:  # Windows
    resource = None

_PACKAGES = ("torch", "numpy", "scipy", "numba")


def build_report(
    solution: Solution,
    *,
    request: Mapping[str, Any],
    measures: Mapping[str, Any],
    seed: int | None = None,
    prior: Mapping[str, Any] | None = None,
    timing: Mapping[str, Any] | None = None,
) -> dict[str, Any]:
    """Build the report on any job; `prior` holds the name, licence and quality of what moved the character.

    Keys: mapctl, request, seed, versions, prior, status, motion, ledger, measures, mocap, timing, and the job's own
    (see `Solution.details`). Without `timing` it is the cost of the solution's windows.
    """
    status, motion = solution.status, solution.motion
    report = {
        "mapctl": __version__,
        "request": dict(request),
        "seed": seed,
        "versions": package_versions(),
        "prior": None if prior is None else {name: value for name, value in prior.items() if name != "quality"},
        "status": {"text": status.text, "outcome": status.outcome.value, "ok": status.ok, "notes": list(status.notes)},
        "motion": {"frames": motion.num_frames, "fps": float(motion.fps), "seconds": motion.seconds},
        "ledger": solution.ledger.summary(),
        "measures": dict(measures),
        "mocap": None if prior is None else prior.get("quality", {}).get("mocap", {}),
        "timing": timing or summarise_timing(solution.windows, seconds=solution.seconds),
        "seconds": solution.seconds,
    }
    return {key: value for key, value in report.items() if value is not None} | solution.details()


def write_report(report: Mapping[str, Any], path: str | PathLike[str]) -> None:
    """Write a report whole or not at all; RequestError if the path cannot be written."""
    write_text(path, to_json(report))


def to_json(values: Any) -> str:
    """Format indented JSON that every parser reads: NaN and infinities are null."""
    return json.dumps(_replace_non_finite(values), indent=1, allow_nan=False) + "\n"


def summarise_timing(windows: Sequence[WindowRecord], *, seconds: float) -> dict[str, float | int | None]:
    """Compute of each delivered frame (a window's time over the frames it commits), ms, and its company.

    A followed curve has no due times, so there are no late frames to count.
    """
    frames = [window.frames for window in windows]
    each = (
        np.repeat([1000 * w.seconds / max(1, w.frames) for w in windows], frames) if windows else np.array([math.nan])
    )
    return {
        "frame_ms_p50": float(np.percentile(each, 50)),
        "frame_ms_p99": float(np.percentile(each, 99)),
        "frame_ms_mean": float(each.mean()),
        "evaluations_per_frame": sum(w.evaluations for w in windows) / max(1, sum(frames)),
        "windows": len(windows),
        "seconds": seconds,
        "threads": torch.get_num_threads(),
        "cores": os.cpu_count(),
        "peak_memory_mb": peak_memory_mb(),
    }


def peak_memory_mb() -> float | None:
    """Return the peak memory of the process, MiB; None where the system does not tell (Windows)."""
    if resource is None:
        return None
    unit = 1 if platform.system() == "Darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / 2**20


def package_versions() -> dict[str, str]:
    """Return versions of mapctl, Python and the packages that decide the numbers, and the platform."""
    installed = {name: metadata.version(name) for name in _PACKAGES}
    return {"mapctl": __version__, "python": platform.python_version(), **installed, "platform": platform.platform()}


def _replace_non_finite(values: Any) -> Any:
    """Replace NaN and infinities in a tree by null."""
    match values:
        case float():
            return values if math.isfinite(values) else None
        case Mapping():
            return {str(name): _replace_non_finite(value) for name, value in values.items()}
        case list() | tuple():
            return [_replace_non_finite(value) for value in values]
        case _:
            return values
