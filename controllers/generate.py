"""Random generation of any length (rnn paper, sections 4.1.4 and 5.1): sample the prior frame after frame."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import torch

from mapctl import retarget
from mapctl.errors import RequestError
from mapctl.features import PRIOR_FPS, Place, decode, encode, root_places
from mapctl.motion import Motion

_CHUNK = 600


@dataclass(frozen=True)
class GenerateSettings:
    """How motion is drawn."""

    temperature: float = 1.0
    """Spread of the draws: 0 is the prior's mean, 1 the prior itself."""
    start: int | None = None
    """Which of the prior's starts; drawn if None."""

    def __post_init__(self):
        if not 0 <= self.temperature <= 2:
            raise RequestError(f"the temperature must lie between 0 and 2, got {self.temperature:g}")


def stream(
    prior: Any, *, seconds: float, generator: torch.Generator, settings: GenerateSettings | None = None,
    start_clip: Motion | None = None,
) -> Iterator[Motion]:  # fmt: skip
    """Consecutive pieces of one motion at PRIOR_FPS, at most 20 s each, so that memory does not grow with its length.

    Begins at the origin facing +Z, or at the end of `start_clip` (any known rig), whose frames warm up the memory.
    RequestError, at once, for a length or a start that cannot be.
    """
    settings = settings or GenerateSettings()
    if not 0 < seconds < float("inf"):
        raise RequestError(f"seconds must be positive, got {seconds:g}")
    frames = max(2, round(seconds * PRIOR_FPS))
    state, place = begin(prior, settings, start_clip, generator)
    return _pieces(prior, state, place, frames, generator, settings.temperature)


def _pieces(
    prior: Any, state: Any, place: Place, frames: int, generator: torch.Generator, temperature: float
) -> Iterator[Motion]:
    while frames > 0:
        features, state = prior.sample(state, min(frames, _CHUNK), generator, temperature=temperature)
        yield decode(features[0], place)
        ground, heading = root_places(features[0].double(), place)
        place, frames = Place(ground[-1], heading[-1]), frames - features.shape[1]


def generate(
    prior: Any, *, seconds: float, generator: torch.Generator, settings: GenerateSettings | None = None,
    start_clip: Motion | None = None,
) -> Motion:  # fmt: skip
    """The whole motion at once; see `stream`."""
    pieces = stream(prior, seconds=seconds, generator=generator, settings=settings, start_clip=start_clip)
    motion = next(pieces)
    for piece in pieces:
        motion = motion.join(piece)
    return motion


def begin(prior: Any, settings: GenerateSettings, clip: Motion | None, generator: torch.Generator) -> tuple[Any, Place]:
    """The prior's state and the place (float64) before the first frame: a start of its own, or the end of a clip."""
    if clip is not None:
        canonical, _ = retarget.to_canonical(clip)
        features, place = encode(canonical.resample(PRIOR_FPS))
        ground, heading = root_places(features, place)
        seen = features.float()
        state = prior.advance(prior.initial_state(seen[:1]), seen[1:].unsqueeze(0))
        return state, Place(ground[-1], heading[-1])
    count = len(prior.starts.speed)
    if settings.start is not None and not 0 <= settings.start < count:
        raise RequestError(f"the prior has starts 0 to {count - 1}, got {settings.start}")
    drawn = int(torch.randint(count, (1,), generator=generator))
    pick = drawn if settings.start is None else settings.start
    return prior.starts.state.pick(torch.tensor([pick])), Place.origin(torch.float64)
