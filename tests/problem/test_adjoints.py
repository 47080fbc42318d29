"""Hand-written gradients against autograd of the terms' own energies, term by term and through the whole chain."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from catalogue import DENSITIES, FRAMES, PAST, TERMS, trial
from helpers import generator, tiny_density, walk

from mapctl.features import LAYOUT, encode, integrate_root
from mapctl.kinematics.fast import WorldPoses
from mapctl.problem.objective import Objective
from mapctl.problem.unknowns import LatentNoise, WindowContext
from mapctl.skeleton import CANONICAL
from mapctl.terms import LatentPrior
from mapctl.terms.base import DifferentiatedTerm, TrialGradient

BY_HAND = {name: term for name, term in TERMS.items() if isinstance(term, DifferentiatedTerm)}
PARTS = ("features", "noise", "log_density")


def pulled(term, whole):
    """Energies of a term and their gradient on the parts of a trial, by hand."""
    gradient = TrialGradient.zeros(whole)
    poses = WorldPoses.compute(whole.features, whole.start, whole.skeleton)
    energy = term.add_gradient(replace(whole, world_poses=poses), gradient)
    on_world = (gradient.root_xz_world, gradient.heading, gradient.joints_world, gradient.heels_world)
    on_features = gradient.features + poses.pull_back(*on_world)
    return energy, (on_features, gradient.noise, gradient.log_density)


def specified(term, whole):
    """The same by autograd in double precision."""
    exact = replace(
        whole,
        **{part: getattr(whole, part).double().requires_grad_() for part in PARTS},
        before=whole.before.double(),
        start=type(whole.start)(whole.start.position_xz.double(), whole.start.heading.double()),
    )
    energy = term(exact)
    leaves = [getattr(exact, part) for part in PARTS]
    gradients = torch.autograd.grad(energy.sum(), leaves, materialize_grads=True)
    return energy.detach().numpy(), tuple(gradient.numpy() for gradient in gradients)


def assert_near(ours, theirs, share=1e-4):
    assert np.linalg.norm(np.asarray(ours) - theirs) <= share * np.linalg.norm(theirs) + 1e-9


@pytest.mark.parametrize("name", BY_HAND)
@pytest.mark.parametrize(("batch", "past", "seed"), [(1, PAST, 0), (3, PAST, 1), (2, 0, 2), (4, 1, 3)])
def test_a_gradient_is_that_of_autograd(name, batch, past, seed):
    whole = trial(batch, dtype=torch.float32, past=past, seed=seed, disturbed=0.2)
    if seed == 3:  # planted toes that rest, where the speed's root has a kink
        whole = replace(whole, features=whole.features * 0.0)
    if seed == 1:  # each candidate has a start of its own
        own = whole.start.position_xz + torch.arange(batch)[:, None]
        whole = replace(whole, start=type(whole.start)(own, whole.start.heading.expand(batch)))
    energy, ours = pulled(BY_HAND[name], whole)
    wanted, theirs = specified(BY_HAND[name], whole)
    assert_near(energy, wanted)
    for part, other in zip(ours, theirs, strict=True):
        assert_near(part, other)


def context(density):
    """The window after the walk's first frames, by a density."""
    motion = walk(PAST + FRAMES, turn_rate=0.2)
    vectors, start = encode(motion)
    ground, heading = integrate_root(vectors[:PAST], start)
    position = type(start)(ground[-1].float(), heading[-1].float())
    before = motion.joint_positions()[:PAST].float()
    kind = density.initial_states.state.last_frame.dtype
    state = density.start_after(vectors[PAST - 1 : PAST].to(kind))
    return WindowContext(
        density,
        state,
        position,
        before,
        FRAMES,
        CANONICAL,
        contacts_before=torch.tensor([True, False]),
        first_frame=PAST,
    )


SETS = {
    "steering": ("noise", "travel, facing", "steps", "footing"),
    "following": ("noise", "path of the hips", "footing"),
    "heels": ("noise", "footing of heels"),
    "with others": ("noise", "likelihood", "clear of a disc and a box", "path in space", "seam"),
}


@pytest.mark.parametrize("kind", SETS)
@pytest.mark.parametrize("batch", [1, 3])
def test_the_objective_is_that_of_autograd(kind, batch):
    """Over the kernels' rollout, in its own precision: to 1e-4."""
    terms = [TERMS[name] for name in SETS[kind]]
    noise = 0.5 * torch.randn(batch, FRAMES * LAYOUT.continuous, generator=generator(batch))
    unknowns = LatentNoise.from_unknowns(context(DENSITIES["kernels"]), noise)
    objective, plain = Objective.of(unknowns, terms), Objective(unknowns.build, terms)
    assert objective.adjoint is unknowns
    for points in (noise, 1.3 * noise, noise):  # memory is used again
        for ours, theirs in zip(objective.energy_and_gradient(points), plain.energy_and_gradient(points), strict=True):
            assert ours.dtype == torch.float32
            assert_near(ours, theirs.numpy())


def test_a_density_without_kernels_is_differentiated_by_hand_but_for_its_rollout():
    density = tiny_density()
    plain = replace(density, use_fast=False)
    noise = 0.5 * torch.randn(2, FRAMES * LAYOUT.continuous, generator=generator(1))
    terms = [TERMS[name] for name in SETS["steering"]]
    for each in (density, plain):
        unknowns = LatentNoise.from_unknowns(context(each), noise)
        assert unknowns.build_detached(noise) is not None
        ours = Objective.of(unknowns, terms).energy_and_gradient(noise)
        for part, other in zip(ours, Objective(unknowns.build, terms).energy_and_gradient(noise), strict=True):
            assert_near(part, other.numpy())


def test_double_precision_is_left_to_autograd():
    noise = 0.5 * torch.randn(1, FRAMES * LAYOUT.continuous, generator=generator(1), dtype=torch.float64)
    base = context(DENSITIES["several"])
    exact = replace(
        base,
        ground_pose=type(base.ground_pose)(base.ground_pose.position_xz.double(), base.ground_pose.heading.double()),
    )
    unknowns = LatentNoise.from_unknowns(exact, noise)
    assert unknowns.build_detached(noise) is None
    energy, gradient = Objective.of(unknowns, [LatentPrior(), TERMS["footing"]]).energy_and_gradient(noise)
    assert energy.dtype == gradient.dtype == torch.float64
