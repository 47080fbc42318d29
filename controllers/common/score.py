"""The energy of a finished motion: what it would cost the MAP problem as it stands, whoever proposed it."""

from dataclasses import replace

import torch
from jaxtyping import Bool
from torch import Tensor

from controllers.common.map_refinement import RefinementSettings, estimate_rest_height
from mapctl.features import LAYOUT, PRIOR_FPS, GroundPose, encode, integrate_root
from mapctl.motion import Motion
from mapctl.problem import density_selection
from mapctl.problem.ledger import Ledger
from mapctl.problem.objective import Objective
from mapctl.problem.receding_horizon import replay
from mapctl.protocols import Density
from mapctl.retarget import to_canonical
from mapctl.retarget.rigs import Rig
from mapctl.terms import Clearance, Jerk, Likelihood, Support, Term
from mapctl.terms.trial import Trial

_PRECEDING_FRAMES = 3  # frames that the others are seen after


def score(
    motion: Motion,
    stands: Bool[Tensor, "frames 2"],
    density: Density,
    settings: RefinementSettings,
    rig: Rig | None = None,
) -> Ledger:
    """By term: the likelihood under a density, footing, clearance, what the body stands on, and jerk, of a motion on
    any rig of more than three frames at the prior's rate; `stands` are its contacts at that rate.
    """
    canonical = to_canonical(motion, rig)[0].resample(PRIOR_FPS)
    bits = stands[: canonical.num_frames]
    features, before = encode(canonical)
    features[: len(bits), LAYOUT.slices["contacts"]] = bits.to(features)
    features = features.float()
    ground, heading = integrate_root(features.double(), before)
    place = GroundPose(ground[_PRECEDING_FRAMES - 1].float(), heading[_PRECEDING_FRAMES - 1].float())
    shown = features[None, _PRECEDING_FRAMES:]
    judge = density.with_observation_noise(density_selection.proposal_sigma())
    state = replay(judge, features[:_PRECEDING_FRAMES], judge.infer_state(features))
    with torch.no_grad():
        log_density = judge.log_prob(shown, state)
    height = estimate_rest_height(canonical, bits)
    terms: list[Term] = [Likelihood(settings.temperature), replace(settings.footing, rest_height=height)]
    terms.append(replace(settings.clearance or Clearance(), rest_height=height))
    terms.append(Support(rest_height=height))
    terms.append(settings.jerk or Jerk(sigma=50.0, frames=len(features)))
    contacts = features[:, LAYOUT.slices["contacts"]] > 0.5
    trial = Trial(
        shown,
        place,
        contacts=contacts[None, _PRECEDING_FRAMES:],
        log_density=log_density,
        before=canonical.joint_positions()[:_PRECEDING_FRAMES].float(),
        contacts_before=contacts[_PRECEDING_FRAMES - 1],
        skeleton=canonical.skeleton,
        first_frame=_PRECEDING_FRAMES,
    )
    return Objective(lambda unknowns: trial, terms).build_ledger(trial)
