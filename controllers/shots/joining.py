"""Spans of a shot joined into one motion: when the first step begins and which foot takes the last one.

Both are choices with several basins: a few frames earlier another foot is in the air. What is tried is a grid, samples,
a particle swarm, or the middle alone; what the in-betweener makes of it is judged as a viewer would.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise, product
from typing import Literal

import torch
from jaxtyping import Bool
from torch import Tensor

from controllers.shots.transitions import Transition, join_across, measure_transition_cost
from controllers.shots.way import Span
from mapctl.motion import Motion
from mapctl.protocols import Inbetweener
from mapctl.solver.swarm import SwarmSettings, run_swarm

TAIL = 14
"""Frames that a walk goes on for a later last step."""
_STILL_START, _STILL_END = 12, 26  # frames of standing at least, where a shot begins and ends with it
_SHORTEST = 12  # frames of a transition
_HASTY = 20  # frames of a transition for which there is no room
_SETTLED = 8  # frames that are left of a walk between two transitions
_PARTICLES = 5

Search = Literal["middle", "grid", "samples", "swarm"]
"""How transitions are tried."""


@dataclass(frozen=True)
class JoinSettings:
    """How transitions are tried."""

    search: Search = "grid"
    """Which."""
    evaluations: int = 15
    """Transitions that samples and swarm try, each."""
    seed: int = 0
    """Seed of samples and swarm."""


@dataclass(frozen=True, eq=False)
class Piece:
    """One span's motion, over all frames of the shot; frames outside of it hold."""

    span: Span
    """The span."""
    motion: Motion
    """As many frames as the shot has."""


@dataclass(frozen=True)
class _Room:
    """Where a transition may lie: so many frames after a span's edge, so long."""

    edge: int
    """Frame from which steps count."""
    steps: tuple[int, ...]
    """Frames after the edge that are tried on a grid, rising."""
    lengths: tuple[int, ...]
    """Lengths that are tried on a grid, rising."""
    counts_stop: bool
    """Whether the edge is the next span's, so that steps are of the transition's end."""
    earliest: int
    """First frame that it may take."""
    latest: int
    """One past the last frame that it may take."""

    def lay(self, step: int, length: int) -> Transition | None:
        """Lay the transition; None where there is no room for it."""
        start = self.edge + step - (length if self.counts_stop else 0)
        found = Transition(start, start + length)
        fits = self.earliest <= found.start and found.stop <= self.latest and length >= _SHORTEST
        return found if fits else None


def join_pieces(
    pieces: Sequence[Piece], inbetweener: Inbetweener, settings: JoinSettings | None = None
) -> tuple[Motion, Bool[Tensor, " frames"]]:
    """Join pieces by the transitions that cost least; also return the frames that the in-betweener is to make."""
    settings = settings or JoinSettings()
    joined = pieces[0].motion
    missing = torch.zeros(joined.num_frames, dtype=torch.bool)
    earliest = 0
    for before, after in pairwise(pieces):
        room = _find_room(before.span, after.span, joined.num_frames, earliest)
        chosen = _search(_CostOfTransitions(joined, after.motion, inbetweener), room, settings)
        if chosen is None:
            chosen = _lay_hasty_transition(before.span, after.span, joined.num_frames, earliest)
        joined = join_across(joined, after.motion, chosen)
        missing[chosen.start : chosen.stop] = True
        earliest = chosen.stop + _SETTLED
    return joined, missing


def _find_room(before: Span, after: Span, frames: int, earliest: int) -> _Room:
    """Find where a transition from one span to the next may lie, so that enough is left of both."""
    own = before.start + (_SETTLED if before.what == "walk" else _STILL_START if before.start == 0 else 1)
    latest = after.stop - 1
    if after.what == "stand" and after.stop == frames:
        latest = min(latest, frames - _STILL_END)
    earliest = max(earliest, own)
    if before.what == "walk":
        return _Room(before.stop, (-12, -8, -4, 0, 4, 8), (26, 34), False, earliest, latest)
    # From standing to walking one may begin at once; from a stand to the next there may be more than a step.
    longest = after.start - (earliest if after.what == "walk" else before.stop)
    lengths = tuple(sorted({18, 26, longest}))
    return _Room(after.start, (0, 4, 8, 12, 16), lengths, True, earliest, latest)


@dataclass(eq=False)
class _CostOfTransitions:
    """What each transition costs, measured once."""

    before: Motion
    """Motion that it leaves."""
    after: Motion
    """Motion that it leads to."""
    inbetweener: Inbetweener
    """That makes it."""

    def __post_init__(self):
        self.known: dict[Transition, float] = {}

    def __call__(self, one: Transition) -> float:
        if one not in self.known:
            self.known[one] = measure_transition_cost(self.before, self.after, one, self.inbetweener)
        return self.known[one]


def _search(cost: _CostOfTransitions, room: _Room, settings: JoinSettings) -> Transition | None:
    """Search a room for the transition that costs least; None where nothing fits."""
    grid = [found for step, length in product(room.steps, room.lengths) if (found := room.lay(step, length))]
    if len(grid) <= 1 or settings.search == "middle":
        return grid[len(grid) // 2] if grid else None
    if settings.search == "grid":
        return min(grid, key=cost)
    generator = torch.Generator().manual_seed(settings.seed)
    low = torch.tensor([room.steps[0], room.lengths[0]], dtype=torch.float64)
    high = torch.tensor([room.steps[-1], room.lengths[-1]], dtype=torch.float64)
    if settings.search == "samples":
        drawn = low + (high - low) * torch.rand(settings.evaluations, 2, generator=generator, dtype=torch.float64)
        tried = [found for point in drawn.round().long().tolist() if (found := room.lay(*point))]
        return min([grid[len(grid) // 2], *tried], key=cost)
    return _fly(cost, room, (low, high), settings, generator) or grid[len(grid) // 2]


def _fly(
    cost: Callable[[Transition], float],
    room: _Room,
    bounds: tuple[Tensor, Tensor],
    settings: JoinSettings,
    generator: torch.Generator,
) -> Transition | None:
    """Search by a particle swarm over step and length, both in frames."""
    low, high = bounds

    def costs(points: Tensor) -> Tensor:
        laid = [room.lay(*point) for point in points.round().long().tolist()]
        return torch.tensor([torch.inf if one is None else cost(one) for one in laid], dtype=torch.float64)

    swarm = SwarmSettings(particles=_PARTICLES, iterations=max(1, settings.evaluations // _PARTICLES))
    found = run_swarm(
        costs, start=(low + high) / 2, spread=(high - low) / 3, settings=swarm, bounds=bounds, generator=generator
    )
    return room.lay(*found.x.round().long().tolist())


def _lay_hasty_transition(before: Span, after: Span, frames: int, earliest: int) -> Transition:
    """Lay the transition where no candidate fits: as late as the standing after it allows."""
    stop = min(after.start + 1, after.stop - 1)
    if after.what == "stand" and after.stop == frames:
        stop = min(stop, frames - _STILL_END)
    start = max(earliest, min(before.stop - 1, stop - _HASTY))
    return Transition(start, max(start + 1, stop))


def spread_over(motion: Motion, start: int, frames: int) -> Motion:
    """Place a motion's first frame at `start` of a shot; frames before and after hold its ends."""
    source = (torch.arange(frames) - start).clamp(0, motion.num_frames - 1)
    return replace(
        motion,
        root_position=motion.root_position[source].double(),
        local_quat_xyzw=motion.local_quat_xyzw[source].double(),
    )
