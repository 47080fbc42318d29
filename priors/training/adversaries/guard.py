"""When a generator and its critic have nothing more to tell each other."""

import math
from collections.abc import Sequence
from typing import Any

_CRITIC_WON = 0.98
"""Share that the critic tells apart, over a report, from which it has won."""


def find_winner(rows: Sequence[dict[str, Any]], *, losses: Sequence[str], least: int, step: str) -> str | None:
    """Return why to stop after these rows of losses since the last line of news, if there is a reason: one of the
    `losses` is no number, or over `least` rows the critic has `told` nearly all apart. `step` says where, for the
    reason."""
    if not all(math.isfinite(rows[-1][name]) for name in losses):
        return f"training diverged at {step}"
    if len(rows) >= least and sum(row["told"] for row in rows) / len(rows) > _CRITIC_WON:
        return "the critic has won"
    return None
