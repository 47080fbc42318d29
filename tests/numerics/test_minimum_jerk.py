"""Minimum-jerk motion: the known polynomial, and no jump when the goal changes on the way."""

import numpy as np
import torch

from mapctl.numerics.easing import MinimumJerkTrack


def rest(*values: float) -> MinimumJerkTrack:
    return MinimumJerkTrack.rest_at(torch.tensor(values, dtype=torch.float64))


def test_from_rest_it_is_the_polynomial_of_flash_and_hogan():
    track = rest(1.0).aim(torch.tensor([3.0], dtype=torch.float64), 0.7)
    for frame in range(1, 21):
        track = track.move(1 / 30)
        share = frame / 21
        expected = 1 + 2 * (10 * share**3 - 15 * share**4 + 6 * share**5)
        np.testing.assert_allclose(track.value, expected, atol=1e-9)
        slope = 2 * (30 * share**2 - 60 * share**3 + 30 * share**4) / 0.7
        np.testing.assert_allclose(track.velocity, slope, atol=1e-9)


def test_it_comes_to_rest_exactly_and_on_time():
    track = rest(0.0, 1.0).aim(torch.tensor([2.0, -1.0], dtype=torch.float64), 0.5)
    for _ in range(15):
        assert not track.resting
        track = track.move(1 / 30)
    track = track.move(1 / 30)
    assert track.resting
    assert torch.equal(track.value, track.goal)
    assert float(track.velocity.abs().sum()) == 0.0


def test_a_goal_that_changes_on_the_way_makes_no_jump():
    track, step = rest(0.0), 1 / 300
    found, generator = [], np.random.default_rng(0)
    for frame in range(600):
        if frame % 60 == 0:
            track = track.aim(torch.tensor(generator.normal(size=1)), 0.4)
        track = track.move(step)
        found.append([float(track.value), float(track.velocity), float(track.acceleration)])
    value, velocity, acceleration = np.array(found).T
    np.testing.assert_allclose(np.gradient(value, step)[1:-1], velocity[1:-1], atol=0.02 * np.abs(velocity).max())
    np.testing.assert_allclose(
        np.gradient(velocity, step)[1:-1], acceleration[1:-1], atol=0.06 * np.abs(acceleration).max()
    )
