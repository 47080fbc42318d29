"""The smoothest offsets, against the same equations written out."""

import numpy as np
import pytest

from mapctl.numerics.smooth_offsets import SECOND_DIFFERENCE, find_overlapping_differences, solve_offsets

SPANS = [(0, 9), (0, 3), (3, 4), (3, 5), (4, 9), (8, 9), (7, 9), (1, 8)]


@pytest.mark.parametrize(("start", "stop"), SPANS)
@pytest.mark.parametrize("firm", [0.3, np.linspace(0.1, 2, 9)])
def test_offsets_solve_the_equations(start, stop, firm):
    firm = firm if isinstance(firm, float) else firm[start:stop]
    whole = np.zeros((7, 9))
    for row in range(7):
        whole[row, row : row + 3] = SECOND_DIFFERENCE
    ours = whole[:, start:stop]
    right = np.random.default_rng(0).normal(size=(stop - start, 2))
    wanted = np.linalg.solve(ours.T @ ours + firm * np.eye(stop - start), right)
    assert np.allclose(solve_offsets(right, firm, start=start, frames=9), wanted, atol=1e-12)
    assert list(find_overlapping_differences(start, stop, 9)) == list(ours.any(axis=1).nonzero()[0])
