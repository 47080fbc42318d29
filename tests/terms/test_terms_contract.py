"""Contract of every term that the objective, the solver and the ledger rest on."""

import math
from dataclasses import fields, replace

import pytest
import torch
from catalogue import FRAMES, PAST, TERMS, moved_curve, trial
from helpers import generator, walk

from mapctl import terms
from mapctl.contacts import derive_heel_contacts
from mapctl.curves import line
from mapctl.features import LAYOUT, GroundPose, encode
from mapctl.metrics.feet import locate_heels
from mapctl.rotations import rotate_ground
from mapctl.skeleton import CANONICAL, TOE_REST_HEIGHT, TOES
from mapctl.terms import FootContact, Jerk, LandingSigmas, LatentPrior, Likelihood, Path
from mapctl.terms.foot_contact import HeelSigmas

each_term = pytest.mark.parametrize("name", TERMS)


def rows(whole, picked):
    """The trial of some candidates."""
    names = ("features", "noise", "log_density", "contacts", "heel_contacts")
    parts = {name: getattr(whole, name) for name in names}
    return replace(whole, **{name: None if values is None else values[picked] for name, values in parts.items()})


def test_the_catalogue_has_every_term():
    assert {type(term).__name__ for term in TERMS.values()} == {*terms.__all__} - {"LandingSigmas", "Term", "Trial"}


@each_term
def test_energies_and_residuals_are_one_finite_number_a_frame(name):
    for batch, past, dtype in ((1, 0, torch.float64), (3, 1, torch.float32), (3, PAST, torch.float64)):
        whole = trial(batch, dtype=dtype, past=past)
        for values in (TERMS[name](whole), TERMS[name].residual(whole)):
            assert values.shape == (batch, FRAMES)
            assert values.dtype == dtype
            assert bool(torch.isfinite(values).all())


@each_term
def test_candidates_know_nothing_of_each_other(name):
    whole, term = trial(4), TERMS[name]
    for row in range(4):
        alone = rows(whole, slice(row, row + 1))
        torch.testing.assert_close(term(whole)[row], term(alone)[0], atol=1e-9, rtol=1e-9)
        torch.testing.assert_close(term.residual(whole)[row], term.residual(alone)[0], atol=1e-9, rtol=1e-9)


@each_term
def test_single_precision_is_enough(name):
    single, double = (TERMS[name](trial(dtype=dtype)) for dtype in (torch.float32, torch.float64))
    torch.testing.assert_close(single.double(), double, rtol=2e-3, atol=2e-2)
    single, double = (TERMS[name](trial(dtype=dtype)).sum() for dtype in (torch.float32, torch.float64))
    assert math.isclose(float(single), float(double), rel_tol=1e-4)


@each_term
@pytest.mark.parametrize("past", [0, PAST])
def test_the_gradient_is_that_of_finite_differences(name, past):
    whole, term = trial(2, past=past), TERMS[name]
    parts = [getattr(whole, part) for part in ("features", "noise", "log_density")]
    directions = [torch.randn(part.shape, generator=generator(k), dtype=torch.float64) for k, part in enumerate(parts)]
    directions[0] = 0.1 * directions[0]

    def energy(step):
        moved = [part + step * direction for part, direction in zip(parts, directions, strict=True)]
        return term(replace(whole, features=moved[0], noise=moved[1], log_density=moved[2])).sum() + 0 * step

    step = torch.zeros((), dtype=torch.float64, requires_grad=True)
    (slope,) = torch.autograd.grad(energy(step), step)
    difference = float(energy(1e-6) - energy(-1e-6)) / 2e-6
    # A path's nearest arc is held while it is differentiated: exact but for offset times curvature (about 1 % here).
    tolerance = 2e-2 if isinstance(term, Path) else 1e-5
    assert math.isclose(float(slope), difference, rel_tol=tolerance, abs_tol=1e-6)


@each_term
def test_the_gradient_is_finite_where_nothing_is_wrong(name):
    """Norms have no slope at zero; a term must not answer NaN there."""
    still = trial(1, disturbed=0.0)
    features = still.features[:, :1].expand(1, FRAMES, LAYOUT.size).clone()
    features[..., : LAYOUT.slices["root_height"].start] = 0
    calm = replace(still, features=features.requires_grad_(True), noise=torch.zeros_like(still.noise))
    calm = replace(calm, before=calm.joints_world.detach()[0, :1].expand(PAST, -1, -1))
    (gradient,) = torch.autograd.grad(TERMS[name](calm).sum() + 0 * features.sum(), features)
    assert bool(torch.isfinite(gradient).all())


def moved_obstacle(obstacle, turn, shift):
    """The obstacle where the scene is turned and moved."""
    position = rotate_ground(torch.tensor(obstacle.place).double(), torch.tensor(turn).double())
    x, z = (position + torch.tensor(shift).double()).tolist()
    return replace(obstacle, place=(x, z), turn_deg=obstacle.turn_deg + math.degrees(turn))


@each_term
def test_moving_the_whole_scene_changes_nothing(name):
    here, term, shift, turn = trial(), TERMS[name], (3.0, -2.0), -2.5
    angle = torch.tensor(turn, dtype=torch.float64)
    position = GroundPose(
        rotate_ground(here.start.position_xz, angle) + torch.tensor(shift).double(), here.start.heading + turn
    )
    before, heels = here.before.clone(), here.heels_before.clone()
    for points in (before, heels):
        turned = rotate_ground(points[..., ::2], angle.expand(points.shape[:-1]))
        points[..., ::2] = turned + torch.tensor(shift).double()
    there = replace(here, start=position, before=before, heels_before=heels)
    names = {field.name for field in fields(term)}
    if "curve" in names:
        term = replace(term, curve=moved_curve(term.curve, turn, shift))
    if "velocities" in names:
        turned = {
            name: rotate_ground(getattr(term, name), angle.expand(len(getattr(term, name))))
            for name in ("velocities", "velocities_before")
        }
        term = replace(term, facing=None if term.facing is None else term.facing + turn, **turned)
    if "positions" in names:
        positions = term.positions.clone()
        turned = rotate_ground(positions[..., ::2], angle.expand(positions.shape[:-1]))
        positions[..., ::2] = turned + torch.tensor(shift).double()
        term = replace(term, positions=positions)
    if "position" in names:
        position = rotate_ground(term.position[..., ::2], angle.expand(FRAMES)) + torch.tensor(shift).double()
        term = replace(term, position=torch.stack([position[..., 0], term.position[..., 1], position[..., 1]], dim=-1))
    if "others" in names:
        others = rotate_ground(term.others, angle.expand(term.others.shape[:-1]))
        term = replace(term, others=others + torch.tensor(shift).double())
    if "obstacles" in names:
        term = replace(term, obstacles=tuple(moved_obstacle(one, turn, shift) for one in term.obstacles))
    torch.testing.assert_close(term(there), TERMS[name](here), rtol=1e-6, atol=1e-6)
    torch.testing.assert_close(term.residual(there), TERMS[name].residual(here), rtol=1e-6, atol=1e-6)


def test_likelihood_and_noise_are_their_formulas():
    whole = trial()
    torch.testing.assert_close(Likelihood(3.0)(whole), -whole.log_density / 3)
    torch.testing.assert_close(Likelihood(3.0).residual(whole), -whole.log_density)
    normal = torch.distributions.Normal(0.0, 0.2)
    relative = normal.log_prob(torch.zeros(())) * LAYOUT.continuous - normal.log_prob(whole.noise).sum(-1)
    torch.testing.assert_close(LatentPrior(0.2)(whole), relative)


def test_a_walk_to_the_left_of_a_line_is_off_by_as_much():
    whole = trial(1, disturbed=0.0)
    beside = replace(whole, start=GroundPose(torch.tensor([0.25, 0.0]).double(), torch.tensor(0.0).double()))
    straight = walk(FRAMES + 1)
    vectors, _ = encode(straight)
    beside = replace(beside, features=vectors[None, 1:], before=whole.before[:0])
    hips = beside.root_xz_world[0]
    term = Path(line(length=3), hips[:, 1].clone())
    torch.testing.assert_close(term.residual(beside)[0], hips[:, 0].abs(), atol=1e-6, rtol=0)
    late = replace(term, arcs=term.arcs + 0.16)
    gained = late(beside) - term(beside)
    torch.testing.assert_close(
        gained, torch.full((1, FRAMES), 0.5 * (0.16 / term.sigma_progress) ** 2).double(), atol=1e-4, rtol=0
    )


def test_a_planted_toe_pays_for_speed_and_height_as_its_sigmas_say():
    whole = trial(1, disturbed=0.0)
    planted = torch.ones_like(whole.contacts)
    resting = replace(whole, contacts=planted, contacts_before=planted[0, 0])
    toes = [CANONICAL.index("leftToes"), CANONICAL.index("rightToes")]
    positions = torch.cat([whole.before[-1:, toes], whole.joints_world[0][:, toes]])
    speed = (positions[1:, :, ::2] - positions[:-1, :, ::2]).norm(dim=-1) * 30
    above = positions[1:, :, 1] - TOE_REST_HEIGHT
    expected = 0.5 * ((speed / 0.03) ** 2 + (above / 0.01) ** 2 + (above.clamp(max=0) / 0.005) ** 2).sum(-1)
    term = FootContact(heels=None)
    torch.testing.assert_close(term(resting)[0], expected, rtol=1e-4, atol=1e-4)
    torch.testing.assert_close(term.residual(resting)[0], speed.amax(-1), rtol=1e-4, atol=1e-5)
    free = replace(whole, contacts=~planted)
    assert float(term.residual(free).abs().max()) == 0
    assert float(term(free).max()) < float(term(resting).min()) + 1e-6


@pytest.mark.parametrize("past", [0, PAST])
def test_a_planted_heel_pays_for_speed_and_height_as_its_sigmas_say(past):
    whole = trial(1, disturbed=0.0, past=past)
    planted = torch.ones_like(whole.heel_contacts)
    resting = replace(whole, heel_contacts=planted)
    term, toes = FootContact(heels=HeelSigmas(0.2, 0.05, 0.02)), FootContact(heels=None)
    heels = locate_heels(walk(PAST + FRAMES, turn_rate=0.2))
    positions = heels[PAST - 1 :] if past else heels[[PAST, *range(PAST, PAST + FRAMES)]]
    torch.testing.assert_close(whole.heels_world[0], positions[1:], atol=1e-9, rtol=0)
    speed = (positions[1:, :, ::2] - positions[:-1, :, ::2]).norm(dim=-1) * 30
    above = positions[1:, :, 1] - (TOE_REST_HEIGHT - 0.0201)
    held = 4 * torch.log1p(0.5 * ((speed / 0.2) ** 2 + (above / 0.05) ** 2) / 4)
    expected = (held + 0.5 * (above.clamp(max=0) / 0.02) ** 2).sum(-1)
    torch.testing.assert_close((term(resting) - toes(resting))[0], expected, rtol=1e-4, atol=1e-4)
    residual = torch.maximum(toes.residual(resting)[0], speed.amax(-1))
    torch.testing.assert_close(term.residual(resting)[0], residual, rtol=1e-4, atol=1e-4)
    free = replace(whole, heel_contacts=~planted)
    assert bool((term(free) - toes(free) < expected).all())


def test_heel_contacts_come_from_the_toes_and_the_pose():
    whole = replace(trial(2, disturbed=0.0), heel_contacts=None)
    motion = walk(PAST + FRAMES, turn_rate=0.2)
    toes = motion.joint_positions()[PAST - 1 :, motion.skeleton.indices(TOES)].expand(2, -1, -1, -1)
    heels, drops = locate_heels(motion)[PAST - 1 :].expand(2, -1, -1, -1), torch.tensor([0.0201, 0.0201]).double()
    wanted = derive_heel_contacts(whole.planted, toes, heels, drops, 30.0)
    assert bool(wanted.any())
    assert torch.equal(whole.heels_planted, wanted)
    unknown = replace(whole, before=whole.before[:0])
    assert not unknown.heels_planted[:, 0].any()
    assert torch.equal(unknown.heels_planted[:, 1:], wanted[:, 1:])


def test_the_seam_sees_a_jump_at_its_start_and_nothing_beyond():
    smooth = trial(1, disturbed=0.0)
    jumped = replace(smooth, before=smooth.before + torch.tensor([0.0, 0.05, 0.0]).double())
    calm, loud = Jerk().residual(smooth)[0], Jerk().residual(jumped)[0]
    assert float(loud[:3].min()) > 10 * float(calm.max())
    assert float(loud[3:].abs().max()) == 0
    assert float(Jerk()(replace(smooth, before=smooth.before[:2])).abs().max()) == 0


@pytest.mark.parametrize("past", [0, 1, PAST])
def test_a_toe_pays_for_acceleration_beyond_what_is_free(past):
    whole = trial(1, disturbed=0.02, past=past)
    hard, free = FootContact(heels=None, landing=LandingSigmas(20.0, 5.0)), FootContact(heels=None, landing=None)
    toes = [CANONICAL.index("leftToes"), CANONICAL.index("rightToes")]
    positions = torch.cat([whole.before[-2:, toes], whole.joints_world[0][:, toes]])
    sizes = (positions[2:] - 2 * positions[1:-1] + positions[:-2]).norm(dim=-1) * 30**2
    expected = torch.zeros(FRAMES, dtype=torch.float64)
    expected[FRAMES - len(sizes) :] = 0.5 * (((sizes - 20).clamp(min=0) / 5) ** 2).sum(-1)
    assert float(expected.max()) > 1, "some are harder than what is free"
    torch.testing.assert_close((hard(whole) - free(whole))[0], expected, rtol=1e-3, atol=1e-3)
