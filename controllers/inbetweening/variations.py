"""Several answers to one question: the same keys met by different motions, each with its energy."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial

import torch
from jaxtyping import Float
from torch import Tensor

from controllers.common.score import score
from controllers.inbetweening.canonical_gap import CanonicalGap
from controllers.inbetweening.pipeline import InfillResult, InfillSettings
from controllers.inbetweening.proposers.answers import Proposal
from controllers.inbetweening.proposers.rollout import RolloutSettings, roll_through_gaps, select_likeliest_density
from controllers.inbetweening.tween import tween
from mapctl.errors import RequestError
from mapctl.features import PRIOR_FPS
from mapctl.inbetweening.effector_targets import EffectorTargets
from mapctl.intent.keyframes import Keys
from mapctl.metrics.realism import Diversity, measure_diversity
from mapctl.motion import Motion
from mapctl.problem.ledger import Ledger
from mapctl.protocols import Density, Inbetweener
from mapctl.retarget import to_canonical
from mapctl.retarget.rigs import Rig

MAX_VARIATIONS = 1000
"""Variations at a time."""
_MIN_FRAMES = 8  # frames at the prior's rate: shorter motions have no energy to speak of


@dataclass(frozen=True, eq=False)
class Variation:
    """One answer."""

    infill_result: InfillResult
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


def sample_variations(
    motion: Motion,
    keys: Keys,
    infiller: Inbetweener,
    count: int,
    *,
    rollout_densities: Sequence[Density],
    generator: torch.Generator,
    settings: InfillSettings | None = None,
    rolling: RolloutSettings | None = None,
    densities: Sequence[Density] = (),
    rig: Rig | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Variations:
    """So many motions through the same keys. The first answers are the same however many are asked for.

    The first is that of `tween`; in the others one of `rollout_densities` is drawn from and steered from key to key.
    RequestError for fewer than two, for keys that are too near to each other to leave a choice, and as `tween`.
    """
    if not 2 <= count <= MAX_VARIATIONS:
        raise RequestError(f"variations are 2 to {MAX_VARIATIONS}, got {count}")
    settings, rolling = settings or InfillSettings(), rolling or RolloutSettings()
    make = partial(tween, motion, keys, infiller, settings=settings, densities=densities, rig=rig)
    found = [_make_first(motion, partial(make, rollout_densities=rollout_densities))]
    density = select_likeliest_density(rollout_densities, to_canonical(found[0].motion, rig)[0])
    found += _sample_rollouts(make, count - 1, density, generator, rolling, progress)
    if all(torch.equal(found[0].motion.local_quat_xyzw, other.motion.local_quat_xyzw) for other in found[1:]):
        raise RequestError(f"no two keys have {_format_span(rolling)} between them, which leaves nothing to vary")
    each = tuple(Variation(one, score(one.motion, one.contacts, density, settings.refinement, rig)) for one in found)
    return Variations(each, measure_diversity([one.motion for one in found]))


def lowest_energy(
    motion: Motion,
    keys: Keys,
    infiller: Inbetweener,
    count: int,
    *,
    rollout_densities: Sequence[Density],
    generator: torch.Generator,
    settings: InfillSettings | None = None,
    rolling: RolloutSettings | None = None,
    densities: Sequence[Density] = (),
    rig: Rig | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> InfillResult:
    """The one with the least energy of so many finished answers: from the infiller's proposal, from slerp's, and from
    rollouts; its notes tell all energies. RequestError for fewer than two, and as `tween`.
    """
    if not 2 <= count <= MAX_VARIATIONS:
        raise RequestError(f"the best is of 2 to {MAX_VARIATIONS}, got {count}")
    settings, rolling = settings or InfillSettings(), rolling or RolloutSettings()
    make = partial(tween, motion, keys, infiller, settings=settings, densities=densities, rig=rig)
    found = [_make_first(motion, make), make(another=_propose_interpolation)]
    density = select_likeliest_density(rollout_densities, to_canonical(found[0].motion, rig)[0])
    found += _sample_rollouts(make, count - 2, density, generator, rolling, progress)
    nats = [Variation(one, score(one.motion, one.contacts, density, settings.refinement, rig)).energy for one in found]
    names = ["infiller", "slerp", *(f"rollout {number + 1}" for number in range(count - 2))]
    best, told = (
        min(range(count), key=nats.__getitem__),
        ", ".join(f"{name} {one:.1f}" for name, one in zip(names, nats, strict=True)),
    )
    note = f"the best of {count} is from the {names[best]}; nats a frame: {told}"
    seconds = sum(one.seconds for one in found)
    return replace(found[best], seconds=seconds, notes=(*found[best].notes, note))


def _make_first(motion: Motion, make: Callable[..., InfillResult]) -> InfillResult:
    """The infiller's answer; RequestError for motions too short for an energy."""
    if motion.num_frames < _MIN_FRAMES * motion.fps / PRIOR_FPS:
        raise RequestError(f"a motion of {motion.num_frames} frames leaves nothing to vary")
    return make()


def _sample_rollouts(
    make: Callable[..., InfillResult],
    count: int,
    density: Density,
    generator: torch.Generator,
    rolling: RolloutSettings,
    progress: Callable[[int, int], None] | None,
) -> list[InfillResult]:
    """Answers of a density, each of a seed of its own."""
    found = []
    for number, seed in enumerate(_sample_seeds(count, generator)):
        if progress is not None:
            progress(number, count)
        draws = torch.Generator().manual_seed(seed)
        found.append(make(another=partial(roll_through_gaps, densities=[density], generator=draws, settings=rolling)))
    return found


def _propose_interpolation(
    gap: CanonicalGap, proposal: Motion, odds: Float[Tensor, "frames 2"], targets: EffectorTargets | None
) -> Proposal:
    """Slerp's proposal, with the infiller's contacts."""
    return Proposal(gap.motion, odds)


def _sample_seeds(count: int, generator: torch.Generator) -> Iterator[int]:
    """One for each, the first ones the same however many there are."""
    return (int(torch.randint(2**62, (1,), generator=generator)) for _ in range(count))


def _format_span(rolling: RolloutSettings) -> str:
    return f"{(rolling.shortest + 1) / PRIOR_FPS:.2g} to {(rolling.longest + 1) / PRIOR_FPS:.2g} s"
