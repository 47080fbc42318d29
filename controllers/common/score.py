"""Energy of a finished motion under the MAP problem, whoever proposed it."""

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
