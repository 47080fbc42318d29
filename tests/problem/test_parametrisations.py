"""Unknowns to trials, and the objective over them."""

import pytest
import torch
from catalogue import excite
from helpers import corpus, finite_difference, generator, noise, tiny_density, walk

from mapctl.features import LAYOUT, GroundPose
from mapctl.pose import BodyPose
from mapctl.problem.objective import Objective, Parametrisation
from mapctl.problem.unknowns import LatentNoise, WindowContext
from mapctl.problem.window_solvers import PoseOffsets
from mapctl.terms import FootContact, Jerk, LatentPrior, Likelihood

FRAMES, SIZE = 7, LAYOUT.continuous


def excited():
    density = tiny_density(dtype=torch.float64)
    excite(density.reference, 0)
    return density


def context(density):
    """After some frames of a walk, facing anywhere."""
    seen = corpus().clips()[0][None, :30].double()
    state = density.advance(density.start_after(seen[:, 0]), seen[:, 1:])
    position = GroundPose(torch.tensor([1.0, -2.0]).double(), torch.tensor(0.8).double())
    return WindowContext(density, state, position, walk(10).joint_positions(), FRAMES)


DENSITY = excited()
CONTEXT = context(DENSITY)


def slope(function, at, direction):
    leaf = at.clone().requires_grad_(True)
    (gradient,) = torch.autograd.grad(function(leaf), leaf)
    return float((gradient * direction).sum())


def test_latents_build_the_rollout_of_their_plan():
    draws = noise(3, FRAMES, dtype=torch.float64)
    latents = LatentNoise.from_unknowns(CONTEXT, draws.flatten(1))
    trial = latents.build(draws.flatten(1))
    features, density = DENSITY.rollout(CONTEXT.state.expand(3), draws, latents.plan)
    torch.testing.assert_close((trial.features, trial.log_density), (features, density))
    torch.testing.assert_close(trial.noise, draws)
    assert torch.equal(trial.contacts, LAYOUT.pick(features, "contacts") > 0.5)
    assert trial.start is CONTEXT.ground_pose
    assert trial.before is CONTEXT.before


def test_the_ledger_adds_up_to_the_energy_and_names_every_term():
    unknowns = noise(1, FRAMES, dtype=torch.float64).flatten(1)
    terms = (LatentPrior(), FootContact(), Jerk())
    objective = Objective(LatentNoise.from_unknowns(CONTEXT, unknowns).build, terms)
    ledger = objective.build_ledger(objective.build(unknowns))
    assert [(e.name, e.unit) for e in ledger.entries] == [(t.name, t.unit) for t in terms]
    total = sum(entry.energy.sum() for entry in ledger.entries)
    torch.testing.assert_close(total, objective.energy(unknowns)[0])
    joined = ledger.pick(slice(3)).join(ledger)
    assert all(len(entry.energy) == len(entry.residual) == 3 + FRAMES for entry in joined.entries)
    row = joined.summary()["noise"]
    assert row["energy_nats"] == pytest.approx(float(joined.entries[0].energy.sum()))
    assert row["residual_mean"] <= row["residual_p95"] <= row["residual_max"]


def offsets():
    """Offsets about a stretch of a walk."""
    features = corpus().clips()[0][None, 30 : 30 + FRAMES].double()
    pose = BodyPose.of_features(features[0], CONTEXT.ground_pose)
    bits = LAYOUT.pick(features[0], "contacts") > 0.5
    return PoseOffsets(CONTEXT, pose, bits, torch.full(pose.pack().shape, 0.03, dtype=torch.float64))


def parametrisations():
    """Each kind by its name, with unknowns of the stretch of the walk."""
    zero = torch.zeros(1, FRAMES * SIZE, dtype=torch.float64)
    return {
        "latent noise": (LatentNoise.from_unknowns(CONTEXT, zero), zero),
        "pose offsets": (offsets(), torch.zeros(1, offsets().sigma.numel(), dtype=torch.float64)),
    }


PARAMETRISATIONS = parametrisations()


@pytest.mark.parametrize("name", PARAMETRISATIONS)
def test_every_parametrisation_keeps_its_contract(name):
    """Trials of candidates that are independent, and their gradient."""
    unknowns, begin = PARAMETRISATIONS[name]
    assert isinstance(unknowns, Parametrisation)
    points = begin + 0.3 * torch.randn(3, begin.shape[1], generator=generator(4), dtype=torch.float64)
    trial = unknowns.build(points)
    assert trial.features.shape == (3, FRAMES, LAYOUT.size)
    assert (trial.start, trial.before) == (CONTEXT.ground_pose, CONTEXT.before)
    alone = unknowns.build(points[1:2])
    torch.testing.assert_close(alone.features[0], trial.features[1])
    torch.testing.assert_close(alone.log_density[0], trial.log_density[1])
    energy = Objective(unknowns.build, (LatentPrior(), Likelihood(), FootContact())).energy
    direction = torch.randn(points.shape, generator=generator(5), dtype=torch.float64)
    wanted = finite_difference(lambda at: energy(at).sum(), points, direction)
    assert slope(lambda at: energy(at).sum(), points, direction) == pytest.approx(wanted, rel=1e-4)


def test_pose_offsets_move_the_proposal_by_so_many_sigmas():
    unknowns = offsets()
    still = unknowns.build(torch.zeros(1, unknowns.sigma.numel(), dtype=torch.float64))
    torch.testing.assert_close(still.pose.pack()[0], unknowns.proposal.pack())
    white = torch.zeros(1, FRAMES, unknowns.sigma.shape[1], dtype=torch.float64)
    white[..., 1] = 1.0  # the height, in every frame
    higher = unknowns.build(white.flatten(1))
    lift = higher.pose.root_position[0, :, 1] - unknowns.proposal.root_position[:, 1]
    assert (lift >= unknowns.sigma[:, 1]).all()  # smoothing to unit variance adds what goes together
    assert (higher.pose.heading - still.pose.heading).abs().max() < 1e-9
