"""Variations: different motions through the same keys, each with its energy."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool
from torch import Tensor

from controllers.common.map_refinement import RefinementSettings, estimate_rest_height
from controllers.inbetweening.pipeline import INFILL_REFINEMENT, InbetweenSolution, Pick
from controllers.inbetweening.proposers import (
    EVERY_ROLLOUT_JUMPED,
    AutoInbetweener,
    RolloutInbetweener,
    SlerpInbetweener,
    select_likeliest_density,
)
from mapctl.errors import RequestError
from mapctl.features import LAYOUT, PRIOR_FPS, GroundPose, encode, integrate_root
from mapctl.metrics.realism import Diversity, measure_diversity
from mapctl.motion import Motion
from mapctl.problem import density_selection
from mapctl.problem.objective import Objective
from mapctl.problem.receding_horizon import replay
from mapctl.problem.solution import Ledger
from mapctl.protocols import Density, Inbetweener
from mapctl.retarget import to_canonical
from mapctl.retarget.rigs import Rig
from mapctl.terms import Clearance, Jerk, Likelihood, Support, Term
from mapctl.terms.trial import Trial

_PRECEDING_FRAMES = 3  # frames before those that are scored, on which terms look back


def score(
    motion: Motion,
    contacts: Bool[Tensor, "frames 2"],
    density: Density,
    settings: RefinementSettings,
    rig: Rig | None = None,
) -> Ledger:
    """Compute the energy by term (likelihood under a density, contact, clearance, support, jerk) of a motion on any rig
    of more than three frames at the prior's rate; `contacts` are its contacts at that rate.
    """
    canonical = to_canonical(motion, rig)[0].resample(PRIOR_FPS)
    bits = contacts[: canonical.num_frames]
    features, before = encode(canonical)
    features[: len(bits), LAYOUT.slices["contacts"]] = bits.to(features)
    features = features.float()
    ground, heading = integrate_root(features.double(), before)
    ground_pose = GroundPose(ground[_PRECEDING_FRAMES - 1].float(), heading[_PRECEDING_FRAMES - 1].float())
    shown = features[None, _PRECEDING_FRAMES:]
    blurred = density.with_observation_noise(density_selection.proposal_sigma())
    state = replay(blurred, features[:_PRECEDING_FRAMES], blurred.infer_state(features))
    with torch.no_grad():
        log_density = blurred.log_prob(shown, state)
    height = estimate_rest_height(canonical, bits)[_PRECEDING_FRAMES:]
    terms: list[Term] = [Likelihood(settings.temperature), replace(settings.footing, supports=height)]
    terms.append(replace(settings.clearance or Clearance(), rest_height=height))
    terms.append(Support(rest_height=height))
    terms.append(settings.jerk or Jerk(sigma=50.0, frames=len(features)))
    planted = features[:, LAYOUT.slices["contacts"]] > 0.5
    trial = Trial(
        shown,
        ground_pose,
        contacts=planted[None, _PRECEDING_FRAMES:],
        log_density=log_density,
        before=canonical.joint_positions()[:_PRECEDING_FRAMES].float(),
        contacts_before=planted[_PRECEDING_FRAMES - 1],
        skeleton=canonical.skeleton,
        first_frame=_PRECEDING_FRAMES,
    )
    return Objective(lambda unknowns: trial, terms).build_ledger(trial)


MAX_VARIATIONS = 1000
"""Most variations in one call."""
_MIN_FRAMES = 8  # frames at PRIOR_FPS of the shortest motion whose energy is meaningful

Tweening = Callable[[Inbetweener, torch.Generator], InbetweenSolution]
"""Function that makes one variation: `tween` with its motion, keys and settings bound."""
Drawing = Callable[[int, torch.Generator], Inbetweener]
"""Function that returns the in-betweener of the variation of a number among those drawn."""


@dataclass(frozen=True)
class Source:
    """Who makes the variations after the first."""

    draw: Drawing
    """Draws an in-betweener for each."""
    name: str
    """What one of them is called, as in `rollout`."""
    room: str
    """What two keys need for a choice between them, as in `room for a style`."""


@dataclass(frozen=True, eq=False)
class Variation:
    """One of several motions through the same keys."""

    solution: InbetweenSolution
    """Solution of in-betweening."""
    ledger: Ledger
    """Energy of the finished motion by term: likelihood, footing, clearance, support and jerk."""

    @property
    def energy(self) -> float:
        """Mean energy of a frame, nats: less is likelier."""
        return sum(float(entry.energy.mean()) for entry in self.ledger.entries)


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
    refinement: RefinementSettings = INFILL_REFINEMENT,
    progress: Callable[[int, int], None] | None = None,
) -> Variations:
    """Make so many motions through the same keys. The first ones do not depend on the count.

    The first is by one in-betweener. The others are by those that `source` draws; without, the likeliest density of
    `rollouts` is sampled and steered from key to key. Energies are by that density. RequestError for fewer than two,
    for keys that are too close in time to leave a choice, and where no rollout gets from key to key without a jump.
    """
    if not 2 <= count <= MAX_VARIATIONS:
        raise RequestError(f"variations are 2 to {MAX_VARIATIONS}, got {count}")
    found = [_make_first(make, first, generator)]
    density = _select_density(rollouts, found[0])
    source = source or _roll_out(rollouts, density)
    found += _sample(make, source.draw, count - 1, generator, progress)
    if all(torch.equal(found[0].motion.local_quat_xyzw, other.motion.local_quat_xyzw) for other in found[1:]):
        jumped = any(gap.reason == EVERY_ROLLOUT_JUMPED for other in found[1:] for gap in other.sources)
        cause = f"{EVERY_ROLLOUT_JUMPED} between these keys" if jumped else f"no two keys have {source.room}"
        raise RequestError(f"{cause}, which leaves nothing to vary")
    each = tuple(_score_variation(one, density, refinement) for one in found)
    return Variations(each, measure_diversity([one.motion for one in found]))


def lowest_energy(
    make: Tweening,
    rollouts: RolloutInbetweener,
    count: int,
    *,
    generator: torch.Generator,
    first: Mapping[str, Inbetweener] | None = None,
    source: Source | None = None,
    refinement: RefinementSettings = INFILL_REFINEMENT,
    progress: Callable[[int, int], None] | None = None,
) -> InbetweenSolution:
    """Make so many motions and keep the one with the lowest energy: by the `first` in-betweeners under their names, or
    by the rollouts' fallback and slerp, and sampled by `source`, or from the likeliest density. Its status lists all
    energies. RequestError for fewer than two.
    """
    if not 2 <= count <= MAX_VARIATIONS:
        raise RequestError(f"the best is of 2 to {MAX_VARIATIONS}, got {count}")
    first = first or {"network": AutoInbetweener(rollouts.fallback), "slerp": SlerpInbetweener()}
    found = [make(each, generator) for each in list(first.values())[1:count]]
    found.insert(0, _make_first(make, next(iter(first.values())), generator))
    density = _select_density(rollouts, found[0])
    source = source or _roll_out(rollouts, density)
    drawn = count - len(found)
    found += _sample(make, source.draw, drawn, generator, progress)
    nats = [_score_variation(one, density, refinement).energy for one in found]
    names = [*first, *(f"{source.name} {number + 1}" for number in range(drawn))]
    best = found[index := min(range(count), key=nats.__getitem__)]
    energies = ", ".join(f"{name} {one:.1f}" for name, one in zip(names, nats, strict=False))
    note = f"the best of {count} is from the {names[index]}; nats a frame: {energies}"
    pick = Pick(names[index], dict(zip(names, nats, strict=False)))
    seconds = sum(one.seconds for one in found)
    return replace(best, seconds=seconds, pick=pick, status=best.status.with_notes([note]))


def _roll_out(rollouts: RolloutInbetweener, density: Density) -> Source:
    """Steer rollouts of a density from key to key."""
    rolled = replace(rollouts, densities=[density])
    return Source(lambda number, draws: rolled, "rollout", f"{rollouts.settings.span} between them")


def _make_first(make: Tweening, first: Inbetweener, generator: torch.Generator) -> InbetweenSolution:
    """Make the first variation; RequestError for motions too short for an energy."""
    made = make(first, generator)
    if made.motion.num_frames < _MIN_FRAMES * made.motion.fps / PRIOR_FPS:
        raise RequestError(f"a motion of {made.motion.num_frames} frames leaves nothing to vary")
    return made


def _select_density(rollouts: RolloutInbetweener, made: InbetweenSolution) -> Density:
    return select_likeliest_density(rollouts.densities, to_canonical(made.motion, made.rig)[0])


def _score_variation(made: InbetweenSolution, density: Density, refinement: RefinementSettings) -> Variation:
    return Variation(made, score(made.motion, made.contacts, density, refinement, made.rig))


def _sample(
    make: Tweening, draw: Drawing, count: int, generator: torch.Generator, progress: Callable[[int, int], None] | None
) -> Sequence[InbetweenSolution]:
    """Sample variations, each with a seed of its own: the first ones do not depend on the count."""
    found = []
    for number in range(count):
        if progress is not None:
            progress(number, count)
        seed = int(torch.randint(2**62, (1,), generator=generator))
        draws = torch.Generator().manual_seed(seed)
        found.append(make(draw(number, draws), draws))
    return found
