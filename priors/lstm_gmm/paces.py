"""Paces as labels: what a density is told that somebody is about to do, and how often its data change from one to
another.

Unlike gait and style they do not hold for a clip, but for a moment: the pace with which a window of training ends.
"""

from collections.abc import Mapping
from typing import Any

from mapctl.metrics.pace_changes import PACES

PACE_LABELS = tuple(f"pace={pace}" for pace in PACES)
"""Labels of PACES."""
_CHANGES = {
    ("stand", "walk"): "starts",
    ("walk", "stand"): "stops",
    ("walk", "run"): "changes to a run",
    ("run", "walk"): "changes to a walk",
}


def read_pace_rates(holds: Mapping[str, Any]) -> dict[tuple[str, str], float]:
    """Read changes a second from one pace to another, by both paces, from what a card says that its clips hold."""
    minutes = holds["minutes by pace"]
    return {
        (before, after): holds[name] / (60 * minutes[before])
        for (before, after), name in _CHANGES.items()
        if minutes[before] > 0
    }
