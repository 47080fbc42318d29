"""Several answers to one question: the same keys met by different motions, each with its energy."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from controllers.common.score import energy_of
from controllers.inbetweening.canonical_gap import CanonicalGap
from controllers.inbetweening.pipeline import Infilled, InfillSettings
from controllers.inbetweening.proposers.answers import Answer
from controllers.inbetweening.proposers.rollout import RolloutSettings, likeliest, rolled
from controllers.inbetweening.tween import tween
from mapctl.errors import RequestError
from mapctl.features import PRIOR_FPS
from mapctl.inbetweening.effector_targets import Targets
from mapctl.intent.keyframes import Keys
from mapctl.metrics.realism import Diversity, sample_diversity
from mapctl.motion import Motion
from mapctl.problem.ledger import Ledger
from mapctl.protocols import Inbetweener
from mapctl.retarget import to_canonical
from mapctl.retarget.rigs import Rig

MOST = 1000
"""Variations at a time."""
_SHORTEST = 8  # frames at the prior's rate: shorter motions have no energy to speak of


@dataclass(frozen=True, eq=False)
class Variation:
    """One answer."""

    infilled: Infilled
    """The motion, and how it became so."""
    ledger: Ledger
    """Of the finished motion, by term: likelihood, footing, clearance, support and jerk."""

    @property
    def energy(self) -> float:
        """Nats a frame: less is likelier."""
        return sum(float(entry.energy.mean()) for entry in self.ledger.entries)


@dataclass(frozen=True, eq=False)
class Variations:
    """Several answers."""

    each: tuple[Variation, ...]
    """The first is what is made of the keys if one answer is asked for; the others are drawn."""
    diversity: Diversity
    """How different they are on average."""


def variations(
    motion: Motion,
    keys: Keys,
    infiller: Inbetweener,
    count: int,
    *,
    rollable: Sequence[Any],
    generator: torch.Generator,
    settings: InfillSettings | None = None,
    rolling: RolloutSettings | None = None,
    densities: Sequence[Any] = (),
    rig: Rig | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Variations:
    """So many motions through the same keys. The first answers are the same however many are asked for.

    The first is that of `tween`; in the others densities that are `rollable` are drawn from and steered from key to
    key. RequestError for fewer than two, for keys that are too near to each other to leave a choice, and as `tween`.
    """
    if not 2 <= count <= MOST:
        raise RequestError(f"variations are 2 to {MOST}, got {count}")
    settings, rolling = settings or InfillSettings(), rolling or RolloutSettings()
    make = partial(tween, motion, keys, infiller, settings=settings, densities=densities, rig=rig)
    found = [_first(motion, partial(make, rollable=rollable))]
    density = likeliest(rollable, to_canonical(found[0].motion, rig)[0])
    found += _rollouts(make, count - 1, density, generator, rolling, progress)
    if all(torch.equal(found[0].motion.local_quat_xyzw, other.motion.local_quat_xyzw) for other in found[1:]):
        raise RequestError(f"no two keys have {_span(rolling)} between them, which leaves nothing to vary")
    each = tuple(Variation(one, energy_of(one.motion, one.contacts, density, settings.standing, rig)) for one in found)
    return Variations(each, sample_diversity([one.motion for one in found]))


def best_of(
    motion: Motion,
    keys: Keys,
    infiller: Inbetweener,
    count: int,
    *,
    rollable: Sequence[Any],
    generator: torch.Generator,
    settings: InfillSettings | None = None,
    rolling: RolloutSettings | None = None,
    densities: Sequence[Any] = (),
    rig: Rig | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Infilled:
    """The one with the least energy of so many finished answers: from the infiller's proposal, from slerp's, and from
    rollouts; its notes tell all energies. RequestError for fewer than two, and as `tween`.
    """
    if not 2 <= count <= MOST:
        raise RequestError(f"the best is of 2 to {MOST}, got {count}")
    settings, rolling = settings or InfillSettings(), rolling or RolloutSettings()
    make = partial(tween, motion, keys, infiller, settings=settings, densities=densities, rig=rig)
    found = [_first(motion, make), make(another=_straight)]
    density = likeliest(rollable, to_canonical(found[0].motion, rig)[0])
    found += _rollouts(make, count - 2, density, generator, rolling, progress)
    nats = [
        Variation(one, energy_of(one.motion, one.contacts, density, settings.standing, rig)).energy for one in found
    ]
    names = ["infiller", "slerp", *(f"rollout {number + 1}" for number in range(count - 2))]
    best, told = (
        min(range(count), key=nats.__getitem__),
        ", ".join(f"{name} {one:.1f}" for name, one in zip(names, nats, strict=True)),
    )
    note = f"the best of {count} is from the {names[best]}; nats a frame: {told}"
    seconds = sum(one.seconds for one in found)
    return replace(found[best], seconds=seconds, notes=(*found[best].notes, note))


def _first(motion: Motion, make: Callable[..., Infilled]) -> Infilled:
    """The infiller's answer; RequestError for motions too short for an energy."""
    if motion.num_frames < _SHORTEST * motion.fps / PRIOR_FPS:
        raise RequestError(f"a motion of {motion.num_frames} frames leaves nothing to vary")
    return make()


def _rollouts(
    make: Callable[..., Infilled],
    count: int,
    density: Any,
    generator: torch.Generator,
    rolling: RolloutSettings,
    progress: Callable[[int, int], None] | None,
) -> list[Infilled]:
    """Answers of a density, each of a seed of its own."""
    found = []
    for number, seed in enumerate(_seeds(count, generator)):
        if progress is not None:
            progress(number, count)
        draws = torch.Generator().manual_seed(seed)
        found.append(make(another=partial(rolled, densities=[density], generator=draws, settings=rolling)))
    return found


def _straight(gap: CanonicalGap, proposal: Motion, odds: Float[Tensor, "frames 2"], targets: Targets | None) -> Answer:
    """Slerp's proposal, with the infiller's contacts."""
    return Answer(gap.motion, odds)


def _seeds(count: int, generator: torch.Generator) -> Iterator[int]:
    """One for each, the first ones the same however many there are."""
    return (int(torch.randint(2**62, (1,), generator=generator)) for _ in range(count))


def _span(rolling: RolloutSettings) -> str:
    return f"{(rolling.shortest + 1) / PRIOR_FPS:.2g} to {(rolling.longest + 1) / PRIOR_FPS:.2g} s"
