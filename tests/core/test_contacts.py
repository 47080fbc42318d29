"""Contacts of toes and heels, supports below them and local phases, against plain loops and known steps."""

import math
from itertools import pairwise

import numpy as np
import pytest
import torch
from helpers import walk

from mapctl.contacts import (
    REACH,
    compute_phases,
    compute_rest_log_probability,
    derive_heel_contacts,
    detect_contacts,
    fit_supports,
    mirror_phases,
    reversed_phases,
)
from mapctl.features import LAYOUT, encode, reversed_features
from mapctl.numerics.intervals import true_intervals
from mapctl.skeleton import CANONICAL, TOE_REST_HEIGHT, TOES, find_heel_drops, find_heels


def steps(frames, fps, seed=0):
    """Two toes that stand 0.6 s and swing 0.4 s in turn, with a little noise; metres."""
    rng, time = np.random.default_rng(seed), np.arange(frames) / fps
    toes = np.zeros((frames, 2, 3))
    for foot, phase in enumerate((0.0, 0.5)):
        cycle, part = np.divmod(time + phase, 1.0)
        swing = np.clip((part - 0.6) / 0.4, 0, 1)
        toes[:, foot, 2] = 1.2 * (cycle + (1 - np.cos(np.pi * swing)) / 2)
        toes[:, foot, 1] = 0.02 + 0.1 * np.sin(np.pi * swing)
    return toes + rng.normal(size=toes.shape) * 0.0005


def by_loop(toes, fps, run=3):
    """The definition, frame by frame, for 30 fps; the first frame is left out."""
    out = np.zeros((len(toes) - 1, 2), bool)
    for foot in range(2):
        floor = np.percentile(toes[:, foot, 1], 5)
        stands = [
            toes[t, foot, 1] < floor + 0.025 and np.hypot(*(toes[t, foot, ::2] - toes[t - 1, foot, ::2])) * fps < 0.35
            for t in range(1, len(toes))
        ]
        start = 0
        for t in range(len(stands) + 1):
            if t == len(stands) or not stands[t]:
                out[start:t, foot] = t - start >= run
                start = t + 1
    return out


@pytest.mark.parametrize("seed", range(2))
def test_contacts_are_those_of_the_definition(seed):
    rng = np.random.default_rng(seed)
    for toes in (steps(150, 30, seed), rng.normal(size=(200, 2, 3)) * [0.004, 0.02, 0.004]):
        expected = by_loop(toes, 30)
        assert expected.any()
        assert not expected.all()
        np.testing.assert_array_equal(detect_contacts(toes, 30)[1:].numpy(), expected)


def test_the_first_frame_is_planted_with_the_second():
    still = torch.zeros(10, 2, 3)
    assert detect_contacts(still, 30).all()
    still[0, 0, 1] = 0.1  # the left toe starts in the air
    assert detect_contacts(still, 30)[0].tolist() == [False, True]


FPS = 30.0
DROPS = torch.tensor([0.02, 0.02]).double()


def roll():
    """A foot (both sides alike) that swings in, strikes with the heel, lies flat and rolls off over the toe: positions
    of toe and heel in two seconds, by the pitch of the sole and the place of what it stands on."""
    frames = round(2 * FPS)
    time = torch.arange(frames, dtype=torch.float64)
    pitch = 0.35 * ((20 - time) / 4).clamp(0, 1) - 0.8 * ((time - 40) / 8).clamp(0, 1)  # toes up, then heel up
    forward = 0.14 * torch.stack([torch.zeros(frames).double(), pitch.sin(), pitch.cos()], dim=-1)
    away = torch.stack([0 * time, 0.02 * (16 - time).clamp_min(0), -0.08 * (16 - time).clamp_min(0)], dim=-1)
    away += torch.stack([0 * time, 0.03 * (time - 50).clamp_min(0), 0.08 * (time - 50).clamp_min(0)], dim=-1)
    heel_stands = (pitch >= 0)[:, None]
    flat = torch.tensor([0.0, 0.0, 0.14]).double()
    heel = away + torch.where(heel_stands, 0.0, flat - forward)
    toe = heel + forward
    toe[:, 1] += 0.04
    heel[:, 1] += 0.02
    return toe[:, None].expand(-1, 2, -1), heel[:, None].expand(-1, 2, -1)


def heels_by_loop(toe_contacts, toes, heels, reach=0.02, slow=0.35):
    """The definition frame by frame."""
    low = [[heels[t, k, 1] - toes[t, k, 1] + DROPS[k] < reach for k in range(2)] for t in range(len(toes))]
    flat = torch.tensor(low) & toe_contacts
    out = flat.clone()
    for t in range(1, len(toes) - 1):
        for k in range(2):
            near = heels[t, k, 1] - toes[t + 1, k, 1] + DROPS[k] < reach
            still = (heels[t, k] - heels[t - 1, k])[[0, 2]].norm() * FPS < slow
            if not toe_contacts[t, k] and flat[t + 1, k] and near and still:
                out[t, k] = True
    return out


def test_the_canonical_heel_is_where_it_was_measured():
    for offset in find_heels(CANONICAL):
        torch.testing.assert_close(offset, torch.tensor([0.0, -0.095, -0.05]).double(), atol=1e-4, rtol=0)
    assert find_heel_drops(CANONICAL) == pytest.approx((0.0201, 0.0201), abs=1e-5)


def test_a_heel_stands_from_its_strike_until_it_rolls_off():
    toes, heels = roll()
    bits = detect_contacts(toes, FPS)
    planted = derive_heel_contacts(bits, toes, heels, DROPS, FPS)
    assert torch.equal(planted, heels_by_loop(bits, toes, heels))
    (stands,) = planted[:, 0].nonzero(as_tuple=True)
    assert torch.equal(stands, torch.arange(int(stands[0]), int(stands[-1]) + 1))
    first_toe = int(bits[:, 0].nonzero()[0])
    assert int(stands[0]) == first_toe - 1
    assert int(stands[-1]) < int(bits[:, 0].nonzero()[-1])
    agreement = (planted == detect_contacts(heels, FPS)).double().mean()
    assert float(agreement) > 0.95


POSITIONS = walk(330).joint_positions()
TOE_POSITIONS, HIPS = POSITIONS[:, CANONICAL.indices(TOES)], POSITIONS[:, 0]
PLANTED = detect_contacts(TOE_POSITIONS, 30)
CONTACTS = list(true_intervals(PLANTED))
NO_NOISE = torch.zeros(1, 1).double()


def lifted(heights):
    """The toes of the walk, each contact lifted by its height (metres), and swings linearly between."""
    toes, lifts = TOE_POSITIONS.clone(), torch.zeros(len(TOE_POSITIONS), 2).double()
    for foot in (0, 1):
        known = [
            (start, stop, height) for (at, start, stop), height in zip(CONTACTS, heights, strict=True) if at == foot
        ]
        frame = torch.arange(len(toes)).double()
        for (_, last, low), (first, _, high) in pairwise(known):
            share = ((frame - (last - 1)) / (first - (last - 1))).clamp(0, 1)
            between = (frame >= last) & (frame < first)
            lifts[between, foot] = (low + (high - low) * share)[between]
        for start, stop, height in known:
            lifts[start:stop, foot] = height
        lifts[: known[0][0], foot], lifts[known[-1][1] :, foot] = known[0][2], known[-1][2]
    toes[..., 1] += lifts
    return toes


def at_distance(function):
    """Heights of contacts by a function of the distance from the origin, metres."""
    return [function(float(TOE_POSITIONS[start:stop, foot, 2].median())) for foot, start, stop in CONTACTS]


LENGTH = float(TOE_POSITIONS[-1, 0, 2])
FLOORS = {
    "level": lambda z: 0.0,
    "boxes": lambda z: 0.3 * min(2, int(3 * max(z, 0) / LENGTH)),
    "down the stairs": lambda z: -0.18 * int(8 * max(z, 0) / LENGTH),
    "slope of 2 degrees": lambda z: math.tan(math.radians(2)) * z,
    "slope of 8 degrees": lambda z: math.tan(math.radians(8)) * z,
}


@pytest.mark.parametrize("floor", FLOORS)
@pytest.mark.parametrize("noise", [0.0, 0.008])
def test_toes_rest_on_the_floor_that_their_contacts_show(floor, noise):
    heights = at_distance(FLOORS[floor])
    toes = lifted(heights)
    toes[..., 1] += noise * torch.randn(toes.shape[:2], generator=torch.Generator().manual_seed(3)).double()
    supports = fit_supports(toes, PLANTED)
    for (foot, start, stop), height in zip(CONTACTS, heights, strict=True):
        assert float(supports[start, foot]) == pytest.approx(TOE_REST_HEIGHT + height, abs=0.01)
        assert supports[start:stop, foot].unique().numel() == 1
    assert float((toes[..., 1] - supports)[PLANTED].max()) < 0.03


def resting(toes=TOE_POSITIONS, hips=HIPS, noise=NO_NOISE):
    return compute_rest_log_probability(toes, hips, 30.0, noise) > math.log(0.5)


def test_toes_rest_where_they_are_planted():
    rests = resting()
    assert float(rests[PLANTED].double().mean()) > 0.75
    assert float(PLANTED[rests].double().mean()) > 0.95


PERIODS = [(33, 0.6), (22, 0.35)]
each_gait = pytest.mark.parametrize(("period", "duty"), PERIODS)


def gait_steps(frames, period, duty, begin=0.0):
    """Two toes that stand this share of each period, the right one half a period after the left; the left toe is put
    down at frame `begin`."""
    share = ((torch.arange(frames)[:, None] - begin) / period - torch.tensor([0.0, 0.5])) % 1
    return share < duty


def angles(phases):
    """Phases of both toes, degrees, unwrapped along frames."""
    pairs = phases.unflatten(-1, (2, 2)).numpy()
    return np.degrees(np.unwrap(np.arctan2(pairs[..., 1], pairs[..., 0]), axis=0))


def amplitudes(phases):
    return phases.unflatten(-1, (2, 2)).norm(dim=-1)


def apart(first, second):
    """Angles between phases, degrees, in 0 to 180."""
    return np.abs((first - second + 180) % 360 - 180)


@each_gait
def test_a_period_is_360_degrees(period, duty):
    angle = angles(compute_phases(gait_steps(8 * period, period, duty)))
    inner = slice(2 * period, 5 * period + 1, period)
    np.testing.assert_allclose(np.diff(angle[inner], axis=0), 360, atol=4)
    middle = angle[2 * period : 6 * period]
    assert (np.diff(middle, axis=0) > 0).all()
    line = middle[:1] + 360 * np.arange(4 * period)[:, None] / period
    assert np.abs((middle - line) - (middle - line).mean(axis=0)).max() < 20


@each_gait
def test_the_phase_is_0_amid_the_stance_and_180_amid_the_swing(period, duty):
    angle = angles(compute_phases(gait_steps(8 * period, period, duty)))[:, 0]
    frame = np.arange(len(angle))
    begins = 3 * period - 0.5  # half a frame before the first planted one
    stance, swing = begins + duty * period / 2, begins + (1 + duty) * period / 2
    assert apart(np.interp(stance, frame, angle), 0) < 8
    assert apart(np.interp(swing, frame, angle), 180) < 8


def test_standing_before_and_after_steps_has_none_and_it_fades_without_a_leap():
    planted = torch.ones(260, 2, dtype=torch.bool)
    planted[100:160] = gait_steps(60, 30, 0.6)
    planted[:, 1] = True  # the right toe stands throughout
    phases = compute_phases(planted)
    size = amplitudes(phases)
    assert not size[:, 1].any()
    still = 12 + REACH  # the Gaussian ends four deviations from a change
    assert not size[: 100 - still].any()
    assert not size[160 + still :].any()
    assert float(size[110:150, 0].min()) > 0.7
    assert float(size[80:100, 0].max()) > 0.1
    assert float(phases.diff(dim=0).abs().max()) < 0.6  # 1.7 of amplitude at 12 degrees a frame is 0.4


def test_beside_reversed_features_they_are_reversed_phases():
    features = encode(walk(240, turn_rate=0.4))[0]
    there, back = (compute_phases(LAYOUT.pick(each, "contacts")) for each in (features, reversed_features(features)))
    found = reversed_phases(there)
    assert torch.equal(found[0], found[1])
    torch.testing.assert_close(found[REACH:-REACH], back[REACH:-REACH], atol=0.06, rtol=0)
    assert float((there.flip(0) - back)[REACH:-REACH].abs().max()) > 0.3  # which the frames in reverse are not
    batch = torch.stack([there, mirror_phases(there)])
    assert torch.equal(reversed_phases(batch)[0], found)
    torch.testing.assert_close(reversed_phases(found)[1:], there[1:])
