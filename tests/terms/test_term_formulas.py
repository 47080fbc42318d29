"""Energies and residuals of terms against their formulas on small motions."""

import math
from dataclasses import replace

import pytest
import torch
from helpers import walk, walking_trial

from mapctl.features import LAYOUT, GroundPose, encode
from mapctl.skeleton import CANONICAL, TOES
from mapctl.terms import Clearance, Keyframe, MotionTracking, RootVelocity, StepLength
from mapctl.terms.trial import Trial

CLEARED = 20


TOE_INDICES = CANONICAL.indices(TOES)


@pytest.fixture
def walking():
    return walking_trial(CLEARED)


def toe_speeds_of(walking):
    return torch.stack([walking.step(toe)[..., ::2].norm(dim=-1) for toe in TOE_INDICES], dim=-1)[0] * walking.fps


def test_what_lacks_is_the_height_asked_of_that_speed_less_the_own(walking):
    term = Clearance(height=0.3, speed=0.8, sigma=0.05, rest_height=0.02)
    own = walking.joints_world[0, :, TOE_INDICES, 1] - 0.02
    lacking = (0.3 * (toe_speeds_of(walking) / 0.8).clamp(max=1) - own).clamp_min(0)
    assert float((lacking > 0).double().mean()) > 0
    torch.testing.assert_close(term(walking)[0], 0.5 * (lacking / 0.05).square().sum(-1), atol=1e-4, rtol=1e-4)
    torch.testing.assert_close(term.residual(walking)[0], lacking.amax(-1), atol=1e-5, rtol=1e-5)


KEYED = 6


HAND, FOOT = CANONICAL.index("leftHand"), CANONICAL.index("rightFoot")


@pytest.fixture
def short_walk():
    return walking_trial(KEYED)


def beside(short_walk, *wanted, sigma=0.002):
    """Wants joints so far from where they are: frame, joint and offset."""
    positions = short_walk.joints_world[0].clone()
    mask = torch.zeros(positions.shape[:2], dtype=torch.bool)
    for frame, joint, offset in wanted:
        positions[frame, joint] += torch.tensor(offset).double()
        mask[frame, joint] = True
    return Keyframe(positions, mask, sigma)


def test_the_residual_is_the_distance_and_nothing_where_nothing_is_wanted(short_walk):
    term = beside(short_walk, (1, HAND, (0.03, 0.0, 0.04)), (4, FOOT, (0.0, -0.2, 0.0)))
    wanted = torch.tensor([[0.0, 0.05, 0.0, 0.0, 0.2, 0.0]]).double()
    torch.testing.assert_close(term.residual(short_walk), wanted, atol=1e-7, rtol=0)


def test_the_energy_is_that_of_a_gaussian(short_walk):
    term = beside(short_walk, (1, HAND, (0.03, 0.0, 0.04)), sigma=0.01)
    assert float(term(short_walk)[0, 1]) == pytest.approx(0.5 * 5**2)
    assert float(term(short_walk).sum()) == pytest.approx(0.5 * 5**2)
    assert float(replace(term, sigma=0.02)(short_walk).sum()) == pytest.approx(0.5 * 2.5**2)


TARGET = encode(walk(20, turn_rate=0.3))[0]


def placed(features: torch.Tensor, *, heading: float = 0.0) -> Trial:
    position = GroundPose(torch.tensor([2.0, -1.0]).double(), torch.tensor(heading).double())
    bits = LAYOUT.pick(features, "contacts") > 0.5
    return Trial(features[None], position, contacts=bits[None], before=torch.zeros(0, 21, 3).double())


@pytest.mark.parametrize("heading", [0.0, 2.0, -7.0])
def test_the_motion_itself_costs_nothing_wherever_it_stands(heading):
    term = MotionTracking(TARGET)
    assert float(term(placed(TARGET, heading=heading)).abs().max()) < 1e-12
    assert float(term.residual(placed(TARGET, heading=heading)).max()) < 1e-6


def moved(block: str, by: float, *, column: int = 0) -> torch.Tensor:
    features = TARGET.clone()
    features[:, LAYOUT.slices[block].start + column] += by
    return features


def test_the_way_is_counted_from_the_windows_beginning():
    features = TARGET.clone()
    features[0, LAYOUT.slices["root_displacement_heading"].start] += 0.1  # one side step, kept from then on
    energy = MotionTracking(TARGET, sigma_trajectory=0.2)(placed(features, heading=1.0))
    torch.testing.assert_close(energy[0], torch.full((20,), 0.5 * 0.25).double())


def test_a_pose_costs_the_mean_square_of_its_joints():
    features = moved("joint_rotations", 0.2, column=3 * 9 + 1)
    term = MotionTracking(TARGET, sigma_pose=0.02, effective_joints=5.0)
    result, wanted = (placed(f).joints_world - placed(f).joints_world[:, :, :1] for f in (features, TARGET))
    squares = (result - wanted).square().sum(-1).mean(-1)
    torch.testing.assert_close(term(placed(features)), 0.5 * 5.0 * squares / 0.02**2)
    torch.testing.assert_close(term.residual(placed(features)), squares.sqrt())
    assert float(squares.max()) > 0


FRAMES, PAST = 40, 30


def gliding(speed: float, direction: float, *, facing: float = 0.0) -> Trial:
    """A T-pose that glides at a velocity, now and before."""
    features = torch.zeros(1, FRAMES, LAYOUT.size, dtype=torch.float64)
    angle = torch.tensor(direction - facing, dtype=torch.float64)
    step = speed / 30
    features[..., LAYOUT.slices["root_displacement_heading"]] = step * torch.stack([angle.sin(), angle.cos()])
    features[..., LAYOUT.slices["root_height"]] = 0.9
    before = torch.zeros(PAST, 21, 3, dtype=torch.float64)
    back = -step * torch.arange(PAST - 1, -1, -1)
    before[..., 0] = (back * math.sin(direction))[:, None]
    before[..., 2] = (back * math.cos(direction))[:, None]
    position = GroundPose(torch.zeros(2, dtype=torch.float64), torch.tensor(facing, dtype=torch.float64))
    bits = torch.zeros(1, FRAMES, 2, dtype=torch.bool)
    return Trial(features, position, contacts=bits, before=before)


def wanting(speed: float, direction: float, **more) -> RootVelocity:
    velocity = speed * torch.tensor([math.sin(direction), math.cos(direction)], dtype=torch.float64)
    return RootVelocity(velocity.expand(FRAMES, 2), velocity.expand(PAST, 2), **more)


@pytest.mark.parametrize("direction", [0.0, 2.0, -3.0])
def test_the_wanted_velocity_costs_nothing_whichever_way_it_goes(direction):
    trial = gliding(1.3, direction, facing=0.4)
    assert float(wanting(1.3, direction)(trial).max()) < 1e-12
    assert float(wanting(1.3, direction).residual(trial).max()) < 1e-6


def test_too_slow_costs_under_the_sigma_of_speed():
    energy = wanting(1.5, 0.7, sigma_speed=0.2)(gliding(1.2, 0.7))
    torch.testing.assert_close(energy, torch.full((1, FRAMES), 0.5 * 1.5**2).double())


def test_facing_is_an_angle():
    for turns in (0, 3):
        facing = torch.full((FRAMES,), 0.3 + 2 * math.pi * turns, dtype=torch.float64)
        energy = wanting(1.0, 0.0, facing=facing, sigma_facing=0.5)(gliding(1.0, 0.0, facing=0.1))
        torch.testing.assert_close(energy, torch.full((1, FRAMES), 0.5 * 0.4**2).double())


def test_what_was_missed_before_the_window_is_owed():
    """After a stretch at half the speed, the first frames cost though they are as wanted; the last do not."""
    slow = gliding(0.6, 0.0)
    late = replace(slow, features=gliding(1.2, 0.0).features)
    energy = wanting(1.2, 0.0)(late)[0]
    assert float(energy[0]) > 1
    assert float(energy[-5:].max()) < 1e-9


def stepping(contacts, *, before=None, contacts_before=(False, False)) -> Trial:
    motion = walk(len(contacts) + 1)
    features, start = encode(motion)
    joints = motion.joint_positions()
    past = joints[:0] if before is None else joints[:1]
    return Trial(
        features[1:].unsqueeze(0),
        start,
        contacts=torch.tensor(contacts).unsqueeze(0).bool(),
        before=past,
        contacts_before=torch.tensor(contacts_before),
    )


def toe_at(of: Trial, frame: int, foot: int):
    return of.joints_world[0, frame, of.skeleton.index(("leftToes", "rightToes")[foot])][::2]


def test_it_counts_touch_downs_from_where_the_other_foot_last_stood():
    bits = [(1, 0), (1, 0), (0, 0), (0, 1), (0, 1), (1, 1), (1, 0)]
    of = stepping(bits)
    missed = StepLength(0.5, sigma=0.1).residual(of)[0]
    first = (toe_at(of, 3, 1) - toe_at(of, 1, 0)).norm()
    second = (toe_at(of, 5, 0) - toe_at(of, 5, 1)).norm()
    expected = torch.zeros(7).double()
    expected[3], expected[5] = (first - 0.5).abs(), (second - 0.5).abs()
    torch.testing.assert_close(missed.double(), expected, atol=1e-5, rtol=0)
    torch.testing.assert_close(
        StepLength(0.5, sigma=0.1)(of)[0].double(), 0.5 * (expected / 0.1).square(), atol=1e-3, rtol=0
    )


def test_a_foot_that_stood_just_before_the_window_counts_and_earlier_ones_do_not():
    bits = [(0, 1), (0, 1)]
    assert StepLength(0.5).residual(stepping(bits)).abs().max() == 0
    stood = stepping(bits, before=True, contacts_before=(True, False))
    index = stood.skeleton.index("leftToes")
    apart = (toe_at(stood, 0, 1) - stood.before[-1, index, ::2]).norm()
    assert float(StepLength(0.5).residual(stood)[0, 0]) == pytest.approx(abs(float(apart) - 0.5), abs=1e-5)
