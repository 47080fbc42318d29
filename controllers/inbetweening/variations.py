"""Variations: different motions through the same keys, each with its energy."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool
from torch import Tensor

from controllers.common.map_refinement import estimate_rest_height
from controllers.inbetweening.pipeline import INFILL_REFINEMENT, InbetweenSolution
from controllers.inbetweening.proposers import (
    EVERY_ROLLOUT_JUMPED,
    ROLLOUT_SPAN,
    RolloutInbetweener,
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
from mapctl.terms import Likelihood, Support, Term
from mapctl.terms.trial import Trial

_PRECEDING_FRAMES = 3  # frames before those that are scored, on which terms look back


def score(motion: Motion, contacts: Bool[Tensor, "frames 2"], density: Density, rig: Rig) -> Ledger:
    """Compute the energy by term (likelihood under a density, contact, clearance, support, jerk) of a motion on any rig
    of more than three frames at the prior's rate; `contacts` are its contacts at that rate."""
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
    clearance, jerk = INFILL_REFINEMENT.clearance, INFILL_REFINEMENT.jerk
    assert clearance is not None
    assert jerk is not None
    terms: list[Term] = [
        Likelihood(INFILL_REFINEMENT.temperature),
        replace(INFILL_REFINEMENT.footing, supports=height),
        replace(clearance, rest_height=height),
        Support(rest_height=height),
        jerk,
    ]
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
    ledger: Ledger
    """Energy of the refined motion by term: likelihood, footing, clearance, support and jerk."""

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
    each = (Variation(one, score(one.motion, one.contacts, density, one.rig)) for one in found)
    return Variations(tuple(each), measure_diversity([one.motion for one in found]))
