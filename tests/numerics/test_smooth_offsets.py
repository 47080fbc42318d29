"""The smoothest offsets against the same equations; Gaussian kernels and minimum-jerk motion."""

import math

import numpy as np
import pytest
import torch
from helpers import generator

from mapctl import rotations
from mapctl.numerics import gaussian
from mapctl.numerics.easing import MinimumJerkTrack
from mapctl.numerics.smooth_offsets import interpolate_offsets, interpolate_turns, smooth_between, solve_offsets

SPANS = [(0, 9), (0, 3), (3, 4), (7, 9), (1, 8)]


@pytest.mark.parametrize(("start", "stop"), SPANS)
@pytest.mark.parametrize("firm", [0.3, np.linspace(0.1, 2, 9)])
def test_offsets_solve_the_equations(start, stop, firm):
    firm = firm if isinstance(firm, float) else firm[start:stop]
    whole = np.zeros((7, 9))
    for row in range(7):
        whole[row, row : row + 3] = 1.0, -2.0, 1.0
    ours = whole[:, start:stop]
    right = np.random.default_rng(0).normal(size=(stop - start, 2))
    wanted = np.linalg.solve(ours.T @ ours + firm * np.eye(stop - start), right)
    assert np.allclose(solve_offsets(right, firm, start=start, frames=9), wanted, atol=1e-12)


def tremble(hertz, frames=240, fps=30.0):
    """A sine of this frequency, one for each column."""
    return torch.sin(2 * math.pi * hertz / fps * torch.arange(frames).double())[:, None]


def test_of_a_tremble_half_is_left_and_nearly_all_of_what_is_slower():
    free = torch.zeros(240, dtype=torch.bool)
    for hertz, least, most in ((7.0, 0.45, 0.55), (14.0, 0.0, 0.3), (1.0, 0.99, 1.001)):
        result = smooth_between(tremble(hertz), free, hertz=7.0, fps=30.0)[40:-40]
        assert least < float(result.std() / tremble(hertz)[40:-40].std()) < most


def test_what_is_held_stays_to_the_bit_and_a_straight_line_to_rounding():
    values, held = tremble(9.0), torch.zeros(240, dtype=torch.bool)
    held[[0, 77, 78, 239]] = True
    result = smooth_between(values, held, hertz=7.0, fps=30.0)
    assert torch.equal(result[held], values[held])
    assert float((result - values)[~held].abs().mean()) > 0.1
    line = torch.linspace(-3.0, 4.0, 50).double()[:, None]
    torch.testing.assert_close(smooth_between(line, held[:50], hertz=3.0, fps=30.0), line)
    assert torch.equal(smooth_between(line[:2], held[1:3], hertz=3.0, fps=30.0), line[:2])


def test_offsets_that_do_not_fade_are_the_cubic_that_leaves_and_arrives_at_rest():
    held = torch.ones(34, dtype=torch.bool)
    held[2:-2] = False
    values = torch.zeros(34, 1).double()
    values[-2:] = 0.7
    found = interpolate_offsets(values, held, seconds=math.inf, fps=30.0)[2:-2, 0]
    share = torch.arange(1, 31).double() / 31
    assert float((found - 0.7 * (3 * share**2 - 2 * share**3)).abs().max()) < 0.007
    steps = torch.diff(torch.cat([values[1:2, 0], found, values[-2:-1, 0]]))
    assert float(steps[[0, -1]].max()) < 0.2 * float(steps.max())


def test_joints_turn_until_they_are_as_wanted_and_no_further():
    result = rotations.from_rotation_vector(torch.randn(200, 3, 3, generator=generator()).double())
    wanted = rotations.from_rotation_vector(torch.randn(200, 3, 3, generator=generator(1)).double())
    firm = torch.zeros(200, 3, dtype=torch.bool)
    firm[[20, 100], 0] = True
    firm[100, 1] = True
    found = interpolate_turns(result, wanted, firm, seconds=0.3, fps=30.0)
    same = (found * wanted).sum(dim=-1).abs()
    assert float((1 - same[firm]).max()) < 1e-12
    assert torch.equal(found[:, 2], result[:, 2])  # never firm
    turned = rotations.to_rotation_vector(rotations.multiply(rotations.inverse(result), found)).norm(dim=-1)
    assert float(turned[20, 1]) < 0.1 < float(turned[20, 0])  # a joint is not led by another's keys
    assert float(turned[180:].max()) < 0.03  # and far from keys none is
    assert float(torch.diff(turned[15:26, 0]).abs().max()) < 0.2 * float(turned[20, 0])


LINE = torch.linspace(0, 3, 40, dtype=torch.float64)


def test_smoothing_keeps_lines_inside_and_counts_what_there_is_at_the_ends():
    torch.testing.assert_close(gaussian.smooth(LINE, 2.0, ends="constant")[6:-6], LINE[6:-6])
    ones = torch.ones(40, 2, 3, dtype=torch.float32)
    torch.testing.assert_close(gaussian.smooth(ones, 2.0), ones)
    torch.testing.assert_close(gaussian.average(ones, seconds=0.2, fps=30.0), ones)
    assert float(gaussian.smooth(ones, 2.0, ends="constant")[0].max()) < 0.7


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
