"""Memory and processor time of processes, as the system tells: NaN on those that do not."""

import math
import os
import re
from pathlib import Path

try:
    import resource
except ImportError:  # Windows
    resource = None


def measure_memory_mb(pid: int) -> float:
    """Return the memory of a process, MB: what it shares with others counts by its part (PSS); NaN where unknown."""
    return _read_rollup_mb(pid, "Pss")


def measure_own_memory_mb(pid: int) -> float:
    """Return the memory of a process that it shares with none, MB (USS): what its end gives back; NaN where unknown."""
    return _read_rollup_mb(pid, "Private_Dirty") + _read_rollup_mb(pid, "Private_Clean")


def _read_rollup_mb(pid: int, name: str) -> float:
    try:
        text = Path(f"/proc/{pid}/smaps_rollup").read_text("ascii")
    except OSError:
        return math.nan
    found = re.search(rf"^{name}:\s*(\d+) kB", text, re.MULTILINE)
    return int(found[1]) / 1024 if found else math.nan


def measure_processor_seconds(pid: int) -> float:
    """Return the processor time that a process has used so far, seconds; NaN where unknown."""
    try:
        fields = Path(f"/proc/{pid}/stat").read_text("utf-8").rpartition(")")[2].split()
    except OSError:
        return math.nan
    user, system = fields[11:13]  # fields 14 and 15, of which the name in brackets and two more come before these
    return (int(user) + int(system)) / os.sysconf("SC_CLK_TCK")


def measure_children_seconds() -> float:
    """Return the processor time of all child processes that have ended, seconds; NaN where unknown (Windows)."""
    if resource is None:
        return math.nan
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime
