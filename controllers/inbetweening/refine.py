"""MAP refinement of in-betweening: proposals are refined gap by gap."""

from collections.abc import Sequence
from dataclasses import replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from controllers.common.map_refinement import RefinementSettings, refine
from mapctl.inbetweening import GapQuery, Proposal
from mapctl.inbetweening.effector_targets import EffectorTargets
from mapctl.motion import Motion
from mapctl.numerics.intervals import true_intervals
from mapctl.problem.ledger import Ledger
from mapctl.problem.solution import WindowRecord
from mapctl.protocols import Density
from mapctl.recording import Capture
from mapctl.skeleton import CANONICAL
from mapctl.solver.budget import Budget
from mapctl.solver.lbfgs import LbfgsSettings
from mapctl.terms import Clearance, FootContact, Jerk, Term

_CONTEXT_FRAMES = 16  # frames at the prior's rate, on either side of a gap, that the MAP stage sees
_USUAL_ERROR = 0.03  # metres: median error of a joint at which the sigmas below hold
_TRUST_RANGE = (0.1, 1.0)  # of that factor; above 1 the MAP stage moved proposals no nearer to the truth
INFILL_REFINEMENT = RefinementSettings(
    uncertainty_ramp=8.0,
    unobserved_sigma_deg=2.0,
    unobserved_sigma_cm=2.0,
    jerk=Jerk(sigma=150.0, frames=96),
    clearance=Clearance(),
    footing=FootContact(0.1, 0.05, 0.05, heels=None),
    budget=Budget(evaluations=16),
    lbfgs=LbfgsSettings(max_iterations=16),
)
"""Settings about an infiller's proposal, whose error is larger than a denoiser's: heights of toes stay near the
network's, since styles differ in them, except those of toes that skate; a jerk term. More evaluations lower no
error of a gap."""


def refine_gaps(
    proposal: Proposal,
    query: GapQuery,
    targets: EffectorTargets | None,
    settings: RefinementSettings,
    densities: Sequence[Density],
    terms: Sequence[Term],
) -> tuple[Motion, Ledger, tuple[WindowRecord, ...]]:
    """Refine a proposal gap by gap; also returns the ledger and the cost of its windows."""
    motion, missing = proposal.motion, query.missing
    quats, root = motion.local_quat_xyzw.clone(), motion.root_position.clone()
    trust = None if proposal.spread is None else _compute_trust(proposal.spread)
    ledger, windows = Ledger(), []
    for first, last in _find_gap_windows(missing.frames):
        if last - first < 2:
            continue
        part, part_missing = slice(first, last), missing.slice(first, last)
        capture = Capture.of_motion(
            motion.slice(first, last),
            seen=~part_missing.joints,
            seen_root=~part_missing.root,
            sigma=torch.zeros(CANONICAL.num_joints),
            sigma_root=0.0,
        )
        refined = refine(
            motion.slice(first, last),
            proposal.contact_logits[part],
            capture,
            settings,
            densities=densities,
            targets=None if targets is None else EffectorTargets(targets.places[part], targets.wanted[part]),
            terms=terms,
            first_frame=first,
            trust=None if trust is None else trust[part],
        )
        quats[part] = torch.where(part_missing.joints[..., None], refined.motion.local_quat_xyzw, quats[part])
        root[part] = torch.where(part_missing.root[:, None], refined.motion.root_position, root[part])
        ledger, windows = ledger.join(refined.ledger), [*windows, *refined.windows]
    return replace(motion, root_position=root, local_quat_xyzw=quats), ledger, tuple(windows)


def _compute_trust(spread: Float[Tensor, "frames joints 2"]) -> Float[Tensor, "frames joints"]:
    """Compute by which factor the sigmas of a proposal change: its median error beside the usual one."""
    return (spread[..., 0] / _USUAL_ERROR).clamp(*_TRUST_RANGE).float()


def _find_gap_windows(missing: Bool[Tensor, " frames"]) -> list[tuple[int, int]]:
    """Find first frame and one past the last of each gap with its context; gaps whose contexts overlap are merged."""
    near = missing.clone()
    for _, start, stop in true_intervals(missing[:, None]):
        near[max(0, start - _CONTEXT_FRAMES) : stop + _CONTEXT_FRAMES] = True
    return [(start, stop) for _, start, stop in true_intervals(near[:, None])]
