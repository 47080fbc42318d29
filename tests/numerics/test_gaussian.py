"""Gaussian smoothing along frames, by matrix and by kernel."""

import math

import pytest
import torch
from helpers import generator

from mapctl.numerics import gaussian

LINE = torch.linspace(0, 3, 40, dtype=torch.float64)


def test_weights_are_the_gaussian_of_the_frames_between():
    weight = gaussian.pairwise_weights(5, 2.0, torch.float64)
    assert float(weight[1, 4]) == pytest.approx(math.exp(-9 / 8))
    assert torch.equal(weight, weight.T)
    assert torch.equal(weight.diagonal(), torch.ones(5, dtype=torch.float64))


def test_a_kernel_adds_up_to_one_and_keeps_lines_inside():
    kernel = gaussian.kernel(2.0, 6)
    assert (len(kernel), float(kernel.sum()), int(kernel.argmax())) == (13, pytest.approx(1), 6)
    torch.testing.assert_close(gaussian.convolve(LINE, kernel, "nothing")[6:-6], LINE[6:-6])


def test_matrix_and_kernel_say_the_same():
    values = torch.randn(60, 2, 3, generator=generator(), dtype=torch.float64)
    kernel = gaussian.kernel(1.5, 12)
    wanted = torch.einsum("ts,sjc->tjc", gaussian.averaging_matrix(60, 1.5, values.dtype), values)
    torch.testing.assert_close(gaussian.convolve(values, kernel, "nothing")[12:-12], wanted[12:-12])
    known = gaussian.convolve(torch.ones_like(values), kernel, "nothing")
    torch.testing.assert_close(gaussian.convolve(values, kernel, "nothing") / known, wanted)


def test_white_noise_smoothed_to_unit_variance_keeps_its_variance_in_every_frame():
    matrix = gaussian.unit_variance_matrix(9, 2.0, torch.float64)
    torch.testing.assert_close((matrix @ matrix.T).diagonal(), torch.ones(9).double())
    assert float(matrix.diff(dim=0).abs().max()) < 0.3
