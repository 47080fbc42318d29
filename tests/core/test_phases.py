"""Local phases on steps whose period, order and stillness are known."""

import numpy as np
import pytest
import torch
from helpers import CADENCE, walk

from mapctl.contacts import REACH, compute_phases, mirror_phases, reversed_phases
from mapctl.features import LAYOUT, encode, reversed_features

PERIODS = [(33, 0.6), (22, 0.35)]
each_gait = pytest.mark.parametrize(("period", "duty"), PERIODS)


def steps(frames, period, duty, begin=0.0):
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
    angle = angles(compute_phases(steps(8 * period, period, duty)))
    inner = slice(2 * period, 5 * period + 1, period)
    np.testing.assert_allclose(np.diff(angle[inner], axis=0), 360, atol=4)
    middle = angle[2 * period : 6 * period]
    assert (np.diff(middle, axis=0) > 0).all()
    line = middle[:1] + 360 * np.arange(4 * period)[:, None] / period
    assert np.abs((middle - line) - (middle - line).mean(axis=0)).max() < 20


@each_gait
def test_the_phase_is_0_amid_the_stance_and_180_amid_the_swing(period, duty):
    angle = angles(compute_phases(steps(8 * period, period, duty)))[:, 0]
    frame = np.arange(len(angle))
    begins = 3 * period - 0.5  # half a frame before the first planted one
    stance, swing = begins + duty * period / 2, begins + (1 + duty) * period / 2
    assert apart(np.interp(stance, frame, angle), 0) < 8
    assert apart(np.interp(swing, frame, angle), 180) < 8


def test_the_procedural_walk_steps_at_its_cadence():
    for cadence in (0.8 * CADENCE, CADENCE):
        planted = LAYOUT.pick(encode(walk(240, turn_rate=0.4, cadence=cadence))[0], "contacts")
        angle = angles(compute_phases(planted))[45:-45]
        slope = np.polyfit(np.arange(len(angle)), angle, 1)[0]
        np.testing.assert_allclose(slope, 360 * cadence / 30, rtol=0.02)
        assert apart(angle[:, 0], angle[:, 1]).mean() > 140


@pytest.mark.parametrize("frames", [1, 61])
@pytest.mark.parametrize("bit", [False, True])
def test_a_foot_that_only_stands_or_never_stands_has_none(frames, bit):
    assert not compute_phases(torch.full((frames, 2), bit)).any()


def test_standing_before_and_after_steps_has_none_and_it_fades_without_a_leap():
    planted = torch.ones(260, 2, dtype=torch.bool)
    planted[100:160] = steps(60, 30, 0.6)
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
