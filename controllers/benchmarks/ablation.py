"""Ablation of the solver: warm starts and unknowns compared on the same curves."""

import time
from collections.abc import Sequence
from dataclasses import replace

import torch

from controllers.benchmarks.shared.tables import Row
from controllers.benchmarks.solver import follow_to_end
from controllers.following.follow import FollowSettings
from mapctl import curves
from mapctl.curves import Curve
from mapctl.features import LAYOUT
from mapctl.metrics import measure
from mapctl.problem.feature_states import FeatureStateSolver
from mapctl.problem.solution import Solution
from mapctl.problem.warm_start import BestOfSamples, SwarmProposal
from mapctl.problem.window_solvers import LatentNoiseSolver
from mapctl.protocols import Density
from mapctl.solver.budget import Budget
from mapctl.terms import LatentPrior, Likelihood, Term

_MEASURES = ("path_error_mean_cm", "path_error_max_cm", "contact_speed_cm_s", "jitter_m_s3")


def benchmark_ablation(prior: Density, *, seconds: float = 5.0, seed: int = 0) -> list[Row]:
    """Measure energy, path error and time by warm start and unknowns, on three smooth curves and a corner."""
    shapes = {
        "circle:4": curves.circle(radius=4.0),
        "figure8:2": curves.figure8(radius=2.0),
        "s:6": curves.s(length=6.0),
        "corner": curves.from_points(torch.tensor([[0.0, 0.0], [0.0, 3.0], [3.0, 3.0]], dtype=torch.float64)),
    }
    return [
        {"curve": name, **_evaluate_variant(prior, curve, settings, terms, label, seconds, seed)}
        for name, curve in shapes.items()
        for label, (settings, terms) in list_ablation_variants(prior).items()
    ]


def list_ablation_variants(prior: Density) -> dict[str, tuple[FollowSettings, tuple[Term, ...]]]:
    """List the variants of the ablation by name: settings, and terms beyond those of following."""
    plain, size = LatentNoiseSolver(), LAYOUT.continuous
    best = replace(plain, proposal=BestOfSamples(count=32), budget=Budget(evaluations=152))
    flown = replace(plain, proposal=SwarmProposal(), budget=Budget(evaluations=216))
    states = FeatureStateSolver(prior.feature_std[:size], prior.feature_mean[:size])
    return {
        "latents, zero start": (FollowSettings(method=plain), ()),
        "latents, best of 32": (FollowSettings(method=best), ()),
        "latents, swarm 16 x 6": (FollowSettings(method=flown), ()),
        # Here the noise is that of the network's input, in units of its sigma, and the states need a density.
        "states, 160 evaluations": (FollowSettings(method=states, noise=LatentPrior(sigma=1.0)), (Likelihood(),)),
    }


def _evaluate_variant(
    prior: Density, curve: Curve, settings: FollowSettings, terms: Sequence[Term], label: str, seconds: float, seed: int
) -> Row:
    began = time.process_time()
    solution = follow_to_end(prior, curve, seconds, seed, settings, terms)
    spent = time.process_time() - began
    found = measure(solution.motion, curve)
    return {
        "method": label,
        "energy_nats": _target_energy(solution),
        **{name: found[name] for name in _MEASURES},
        "ms_per_frame": 1000 * spent / solution.motion.num_frames,
    }


def _target_energy(solution: Solution) -> float:
    """Sum the energy of the terms that all variants share, nats (the prior's is measured in different spaces)."""
    return float(sum(e.energy.sum() for e in solution.ledger.entries if e.name in ("path", "footing")))
