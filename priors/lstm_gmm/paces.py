"""Paces as labels: what a density is told that somebody is about to do, and how often its data change from one to
another.

Unlike gait and style they do not hold for a clip, but for a moment: the pace with which a window of training ends.
"""

from collections.abc import Mapping
from typing import Any

from mapctl.metrics.pace_changes import CHANGES, PACES, label_pace

PACE_LABELS = tuple(map(label_pace, PACES))
"""Labels of PACES."""


def read_pace_rates(holds: Mapping[str, Any]) -> dict[tuple[str, str], float]:
    """Read changes a second from one pace to another, by both paces, from what a card says that its clips hold. None of
    a pace that they hold for less than the 0.3 s to which a card rounds."""
    minutes = holds["minutes by pace"]
    return {
        (before, after): holds[name] / (60 * minutes[before])
        for (before, after), name in CHANGES.items()
        if minutes[before] > 0 and minutes[after] > 0
    }
