"""Draws of a stitcher by their number: made in chunks, so that sixteen cost little more than one."""

from collections.abc import Callable
from dataclasses import dataclass, field

import torch

from priors.stitching.joining import Joined
from priors.stitching.sides import Ends

CHUNK = 16
"""Draws at once: batches of one size are rounded alike, so that the first draws do not depend on the count."""
_LARGEST_SEED = 2**63


@dataclass(eq=False)
class Draws:
    """Answers that are drawn, to as many pairs of poses as are asked for."""

    seed: int
    """Of the noise; each pair of poses has noise of its own."""
    temperature: float = 1.0
    """Standard deviation of the noise."""
    dropped: int = 0
    """Draws so far that were not finite, which nobody is given."""
    chunks: dict[tuple[bytes, int, int], Joined] = field(default_factory=dict)
    """Those made, by the ends, the frames from one to the other and the number of the chunk."""

    def seed_chunk(self, start: int, chunk: int) -> torch.Generator:
        """Return the generator of a chunk's noise, for the ends of a gap that starts at a frame."""
        seed = (self.seed + 1_000_003 * start + 7_919 * chunk) % _LARGEST_SEED
        return torch.Generator().manual_seed(seed)

    def pick(
        self, ends: Ends, start: int, frames: int, number: int, make: Callable[[torch.Generator, float], Joined]
    ) -> Joined | None:
        """Return the draw of a number for the ends of a gap that starts at a frame, made by `make` with the chunk that
        it is in if it is not there; the next finite one where it is not finite, and None where the whole chunk is not.
        """
        chunk, row = divmod(number, CHUNK)
        told = b"".join(part.numpy().tobytes() for part in (ends.features, ends.present, ends.place, ends.turn))
        if (made := self.chunks.get((told, frames, chunk))) is None:
            made = make(self.seed_chunk(start, chunk), self.temperature)
            self.chunks[told, frames, chunk] = made
            self.dropped += int((~made.finite).sum())
        good = made.finite.roll(-row).nonzero()
        return made.row((row + int(good[0])) % CHUNK) if len(good) else None
