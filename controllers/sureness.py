"""How sure answers for gaps are: what they were off by in clips that no training saw, by who gave them, how long the
gap was, and whether the body was on its way.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from mapctl.motion import Motion
from mapctl.skeleton import CANONICAL, leg_length

GOING = 0.35
"""Metres a second of the hips, from one end of a gap to the other, of a body with canonical legs, from which it is on
its way."""
KNOWN_FRAMES = 75
"""Of the longest gaps that the infiller was trained on: their mean length and a standard deviation."""
MEASURED: Mapping[tuple[str, str, bool], Sequence[tuple[int, float, float]]] = {
    ("infiller", "going", False): ((15, 5, 9), (180, 40, 80)),
    ("infiller", "in place", False): ((15, 3, 9), (180, 20, 40)),
    ("infiller", "going", True): ((15, 5, 9), (180, 40, 80)),
    ("infiller", "in place", True): ((15, 5, 9), (180, 40, 80)),
}
"""By who answered, whether the body was on its way, and whether frames beside the gap were known: frames of the gap and
centimetres in half and in nine of ten of the clips; `mapctl bench gaps --data DATA --count 30`."""


def going_between(motion: Motion, start: int, stop: int) -> bool:
    """Whether the body (canonical joints) goes elsewhere in a gap, faster than one shifts one's weight."""
    way = float((motion.root_position[stop] - motion.root_position[start])[::2].norm())
    return way * leg_length(CANONICAL) / leg_length(motion.skeleton) > GOING * (stop - start) / float(motion.fps)


@dataclass(frozen=True)
class Sureness:
    """What an answer for a gap is off by, mean over joints and frames, in the world."""

    half_cm: float
    """At most, in half of unseen clips."""
    nine_in_ten_cm: float
    """And in nine of ten."""

    @property
    def text(self) -> str:
        """In words."""
        return (f"joints within {self.half_cm:.0f} cm of mocap's in half of unseen clips and within"
                f" {self.nine_in_ten_cm:.0f} cm in nine of ten")  # fmt: skip


def sureness_of(by: str, frames: int, *, going: bool, beside: bool) -> Sureness:
    """Of an answer for a gap of so many frames at the prior's rate; `beside` where frames around it are known.

    Between measured lengths straight lines; longer gaps than measured are at least as unsure as the longest.
    """
    name = "rollout" if by.split(" ")[0] in ("rollout", "density") else by.split(" ")[0]
    what = "going" if going else "in place"
    rows = MEASURED.get((name, what, beside)) or MEASURED[("infiller", what, beside)]
    lengths, half, most = np.array(rows).T
    return Sureness(*(float(np.interp(frames, lengths, values)) for values in (half, most)))
