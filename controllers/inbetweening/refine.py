"""The MAP stage of infilling: feet put down about what was proposed, gap by gap."""

from collections.abc import Sequence
from dataclasses import replace

import torch
from jaxtyping import Bool
from torch import Tensor

from controllers.common.map_refinement import RefinementSettings, refine
from controllers.inbetweening.canonical_gap import CanonicalGap
from mapctl.inbetweening.effector_targets import EffectorTargets
from mapctl.motion import Motion
from mapctl.numerics.intervals import true_intervals
from mapctl.problem.ledger import Ledger
from mapctl.protocols import Density
from mapctl.recording import Capture
from mapctl.skeleton import CANONICAL
from mapctl.solver.budget import Budget
from mapctl.solver.lbfgs import LbfgsSettings
from mapctl.terms import Clearance, FootContact, Jerk

_CONTEXT_FRAMES = 16  # frames at the prior's rate, on either side of a gap, that the MAP stage sees
INFILL_REFINEMENT = RefinementSettings(
    uncertainty_ramp=8.0,
    unobserved_sigma_deg=2.0,
    unobserved_sigma_cm=2.0,
    jerk=Jerk(sigma=150.0, frames=96),
    clearance=Clearance(),
    footing=FootContact(sigma_speed=0.1, sigma_height=0.05, sigma_below=0.05),
    budget=Budget(evaluations=40),
    lbfgs=LbfgsSettings(max_iterations=40),
)
"""Of the MAP stage about an infiller's proposal, which is further off than a denoiser's: heights of toes are the
network's, since styles differ in them, but for those of toes that skate; jerk costs something; and it may take twice
the evaluations."""


def refine_gaps(
    proposal: Motion,
    bits: Tensor,
    gap: CanonicalGap,
    settings: RefinementSettings,
    densities: Sequence[Density],
    targets: EffectorTargets | None,
) -> tuple[Motion, Ledger]:
    """The proposal with its feet put down, gap by gap; and the ledger of these."""
    quats, root, ledger = proposal.local_quat_xyzw.clone(), proposal.root_position.clone(), Ledger()
    for first, last in _find_gap_windows(gap.turns.any(dim=1) | gap.root):
        if last - first < 2:
            continue
        part = slice(first, last)
        capture = Capture.of_motion(
            proposal.slice(first, last),
            seen=~gap.turns[part],
            seen_root=~gap.root[part],
            sigma=torch.zeros(CANONICAL.num_joints),
            sigma_root=0.0,
        )
        wanted = None if targets is None else EffectorTargets(targets.places[part], targets.wanted[part])
        standing = refine(
            proposal.slice(first, last), bits[part], capture, settings, densities=densities, targets=wanted
        )
        quats[part] = torch.where(gap.turns[part, :, None], standing.motion.local_quat_xyzw, quats[part])
        root[part] = torch.where(gap.root[part, None], standing.motion.root_position, root[part])
        ledger = ledger.join(standing.ledger)
    return replace(proposal, root_position=root, local_quat_xyzw=quats), ledger


def _find_gap_windows(lost: Bool[Tensor, " frames"]) -> list[tuple[int, int]]:
    """First frame and one past the last of each gap with what is beside it; gaps that see each other are one."""
    near = lost.clone()
    for _, start, stop in true_intervals(lost[:, None]):
        near[max(0, start - _CONTEXT_FRAMES) : stop + _CONTEXT_FRAMES] = True
    return [(start, stop) for _, start, stop in true_intervals(near[:, None])]
