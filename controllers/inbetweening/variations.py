"""Variations: different motions through the same keys, each with its energy."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import torch

from controllers.inbetweening.pipeline import InbetweenSolution
from controllers.inbetweening.proposers import (
    EVERY_ROLLOUT_JUMPED,
    ROLLOUT_SPAN,
    RolloutInbetweener,
    select_likeliest_density,
)
from mapctl.errors import RequestError
from mapctl.features import PRIOR_FPS
from mapctl.metrics.realism import Diversity, measure_diversity
from mapctl.problem.density_selection import proposal_sigma, select_density_for_motion
from mapctl.protocols import Inbetweener
from mapctl.retarget import to_canonical

MAX_VARIATIONS = 1000
"""Most variations in one call."""
_MIN_FRAMES = 8  # frames at PRIOR_FPS of the shortest motion whose energy is meaningful

Tweening = Callable[[Inbetweener, torch.Generator], InbetweenSolution]
"""Function that makes one variation: `tween` with its motion, keys and settings bound."""


@dataclass(frozen=True)
class Source:
    """Source of the variations after the first."""

    draw: Callable[[int, torch.Generator], Inbetweener]
    """Draws the in-betweener of the variation of this number among those drawn."""
    room: str
    """Condition on the time between two keys for a choice, as in `room for a style`."""


@dataclass(frozen=True, eq=False)
class Variation:
    """One of several motions through the same keys."""

    solution: InbetweenSolution
    """Solution of in-betweening."""
    energy: float
    """Minus the mean log density of a frame, nats, physical units: less is likelier."""


@dataclass(frozen=True, eq=False)
class Variations:
    """Several motions through the same keys."""

    each: tuple[Variation, ...]
    """Variations; the first is that of a plain `tween`, the others are sampled."""
    diversity: Diversity
    """Average pairwise distances of the variations."""


def sample_variations(
    make: Tweening,
    first: Inbetweener,
    rollouts: RolloutInbetweener,
    count: int,
    *,
    generator: torch.Generator,
    source: Source | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Variations:
    """Make so many motions through the same keys. The first ones do not depend on the count.

    The first is by one in-betweener. The others are by those that `source` draws; without, the likeliest density of
    `rollouts` is sampled and steered from key to key. Energies are by that density. RequestError for fewer than two,
    for keys that are too close in time to leave a choice, and where no rollout gets from key to key without a jump.
    """
    if not 2 <= count <= MAX_VARIATIONS:
        raise RequestError(f"variations are 2 to {MAX_VARIATIONS}, got {count}")
    plain = make(first, generator)
    if plain.motion.num_frames < _MIN_FRAMES * plain.motion.fps / PRIOR_FPS:
        raise RequestError(f"a motion of {plain.motion.num_frames} frames leaves nothing to vary")
    density = select_likeliest_density(rollouts.densities, to_canonical(plain.motion, plain.rig)[0])
    if source is None:
        rolled = replace(rollouts, densities=[density])
        source = Source(lambda number, draws: rolled, f"{ROLLOUT_SPAN} between them")
    found = [plain]
    for number in range(count - 1):
        if progress is not None:
            progress(number, count - 1)
        draws = torch.Generator().manual_seed(int(torch.randint(2**62, (1,), generator=generator)))
        found.append(make(source.draw(number, draws), draws))
    if all(torch.equal(plain.motion.local_quat_xyzw, other.motion.local_quat_xyzw) for other in found[1:]):
        jumped = any(gap.reason == EVERY_ROLLOUT_JUMPED for other in found[1:] for gap in other.sources)
        cause = f"{EVERY_ROLLOUT_JUMPED} between these keys" if jumped else f"no two keys have {source.room}"
        raise RequestError(f"{cause}, which leaves nothing to vary")
    blurred = density.with_observation_noise(proposal_sigma())
    canonical = [to_canonical(one.motion, one.rig)[0] for one in found]
    nats = [select_density_for_motion([blurred], motion).nats[blurred.name] for motion in canonical]
    each = (Variation(one, -density) for one, density in zip(found, nats, strict=True))
    return Variations(tuple(each), measure_diversity([one.motion for one in found]))
