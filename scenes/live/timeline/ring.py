"""Frames of the last two minutes of one character, in memory that never grows."""

from dataclasses import dataclass
from fractions import Fraction

import numpy as np
import torch

from mapctl.features import PRIOR_FPS
from mapctl.mesh.primitives import Array
from mapctl.motion import Motion
from mapctl.runtime.live_protocol import FrameChunk
from mapctl.skeleton import Skeleton

KEPT_SECONDS = 120.0
"""Seconds of motion that are kept."""


@dataclass(frozen=True, eq=False)
class PastMoment:
    """Two frames that follow each other, and a moment between them."""

    number: int
    """Number of the first of them, counted from the character's first frame."""
    motion: Motion
    """Both frames; twice the same at the newest one."""
    contacts: Array
    """(2,) left and right toe planted, 1 or 0, in the first of them."""
    wish: tuple[float, float]
    """Target velocity at that time, x and z, m/s."""
    share: float
    """Share of the second in the moment, 0 to 1."""


class FrameRing:
    """The newest frames, each with the time of the show at which it was seen; a new one takes the oldest's place."""

    def __init__(self, skeleton: Skeleton, seconds: float = KEPT_SECONDS):
        """Take all memory that is ever used."""
        self._skeleton, size, joints = skeleton, round(seconds * PRIOR_FPS), len(skeleton.names)
        self._times = np.full(size, np.nan)  # filled, so that the memory is really taken now
        self._root = np.full((size, 3), 0, np.float32)
        self._quats = np.full((size, joints, 4), 0, np.float32)
        self._contacts = np.full((size, 2), 0, np.float32)
        self._wishes = np.full((size, 2), 0, np.float32)
        self._count = 0  # of all frames that were ever added

    def __len__(self) -> int:
        return min(self._count, len(self._times))

    def add(self, time: float, delivered: FrameChunk, frame: int) -> None:
        """Add a frame that is seen at a time of the show, seconds, which is not before that of the frame before."""
        at = self._count % len(self._times)
        if len(self):
            time = max(time, self.newest)
        self._times[at] = time
        self._root[at], self._quats[at] = delivered.root[frame], delivered.quats[frame]
        self._contacts[at], self._wishes[at] = delivered.contacts[frame], delivered.wish
        self._count += 1

    @property
    def oldest(self) -> float:
        """Time of the oldest frame that is kept, seconds."""
        return float(self._times[self._count % len(self._times) if len(self) == len(self._times) else 0])

    @property
    def newest(self) -> float:
        """Time of the newest frame, seconds."""
        return float(self._times[(self._count - 1) % len(self._times)])

    @property
    def memory_bytes(self) -> int:
        """Bytes that the frames take."""
        return sum(kept.nbytes for kept in (self._times, self._root, self._quats, self._contacts, self._wishes))

    def find(self, time: float) -> PastMoment | None:
        """Find a moment; before the oldest frame it is that, after the newest one that. None where there are none."""
        if not len(self):
            return None
        first = self._count - len(self)
        before = first + max(0, int(np.searchsorted(self._ordered_times(), time, side="right")) - 1)
        after = min(before + 1, self._count - 1)
        one, other = before % len(self._times), after % len(self._times)
        span = self._times[other] - self._times[one]
        share = min(1.0, max(0.0, (time - self._times[one]) / span)) if span > 0 else 0.0
        both = [one, other]
        root, quats = torch.from_numpy(self._root[both]).double(), torch.from_numpy(self._quats[both]).double()
        quats = quats / quats.norm(dim=-1, keepdim=True)  # as 32 bits they are of length 1 to 1e-7 only
        motion = Motion(self._skeleton, Fraction(PRIOR_FPS), root, quats)
        wish = float(self._wishes[one, 0]), float(self._wishes[one, 1])
        return PastMoment(before, motion, self._contacts[one].copy(), wish, float(share))

    def track(self, start: float, end: float, count: int) -> Array:
        """Return (count, 2) places of the root over the ground from one time to another; without any it stays."""
        order = self._order()
        times = self._times[order]
        at = np.linspace(start, end, count)
        return np.stack([np.interp(at, times, axis) for axis in self._root[order][:, ::2].T], axis=1)

    def _order(self) -> Array:
        return np.arange(self._count - len(self), self._count) % len(self._times)

    def _ordered_times(self) -> Array:
        return self._times[self._order()]
