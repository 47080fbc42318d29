"""Windows of clips with a gap in each, as in LaFAN1's protocol (Harvey et al. 2020)."""

from dataclasses import dataclass, replace

from controllers.benchmarks.transitions.methods import Filled
from mapctl.motion import Motion

WINDOW, STRIDE = 65, 40
"""Frames of a test window, and from one to the next."""
PAST = 10
"""Frames before the gap."""


@dataclass(frozen=True, eq=False)
class Gap:
    """One gap of one clip."""

    part: Motion
    """Frames that a method is given."""
    start: int
    stop: int
    """Frames of the gap in it."""
    around: Motion
    """The gap with up to ten true frames on either side."""

    @property
    def filled(self) -> slice:
        """Frames of the gap in `around`."""
        return slice(PAST, PAST + self.stop - self.start)

    @property
    def inner(self) -> Motion:
        """The gap with the two poses beside it."""
        return self.part.slice(self.start - 1, self.stop + 1)


def find_gaps(clip: Motion, length: int, past: int | None) -> list[Gap]:
    """Find the gaps of a canonical clip at PRIOR_FPS, of so many frames, after so many known ones; None shows the whole
    clip."""
    gaps = []
    for first in range(0, clip.num_frames - WINDOW, STRIDE):
        start, stop = first + PAST, first + PAST + length
        begin, end = (0, clip.num_frames) if past is None else (start - past, stop + 1)
        after = min(clip.num_frames, stop + 10)
        part = clip.slice(begin, end)
        gaps.append(Gap(part, start - begin, stop - begin, clip.slice(start - PAST, after)))
    return gaps


def put_in(filled: Filled, gap: Gap) -> Motion:
    """Return the gap as filled, with its true frames around."""
    root, quats = gap.around.root_position.clone(), gap.around.local_quat_xyzw.clone()
    made, here = filled.motion, slice(gap.start, gap.stop)
    root[gap.filled], quats[gap.filled] = made.root_position[here], made.local_quat_xyzw[here]
    return replace(gap.around, root_position=root, local_quat_xyzw=quats)
