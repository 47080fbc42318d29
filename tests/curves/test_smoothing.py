"""Smoothing of drawn paths: jitter goes, what was meant stays."""

import numpy as np
import pytest
import torch

from mapctl import curves
from mapctl.curves import smooth_path


def jittered(curve, *, spacing=0.03, sigma=0.01):
    arcs = torch.linspace(0, curve.length, round(curve.length / spacing), dtype=torch.float64)
    drawn = curve.ground_point(arcs[:-1] if curve.closed else arcs).numpy()
    return curves.from_points(drawn + np.random.default_rng(0).normal(size=drawn.shape) * sigma, closed=curve.closed)


@pytest.mark.parametrize("meant", ["wave:0.5x6", "circle:2", "line:5"])
def test_jitter_goes_and_the_path_that_was_meant_stays(meant):
    meant = curves.read(meant)
    drawn = jittered(meant)
    smooth, note = smooth_path(drawn)
    assert smooth.closed == meant.closed
    assert drawn.length > 1.08 * meant.length
    assert smooth.length == pytest.approx(meant.length, rel=0.02)
    off = (
        smooth.points
        - meant.point(
            meant.nearest(smooth.points, torch.linspace(0, meant.length, len(smooth.points), dtype=torch.float64))
        )
    ).norm(dim=-1)
    assert float(off.max()) < 0.04
    assert note.startswith("the path was smoothed over 20 cm")
    if not meant.closed:
        torch.testing.assert_close(smooth.points[[0, -1]], drawn.points[[0, -1]])


@pytest.mark.parametrize(
    "shape", ["wave:0.6x4", "s:6", "figure8:0.8", "circle:0.6", "circle:0.1", "line:0.3", "wave:0.5x1", "wave:0.6x1.5"]
)
def test_paths_without_jitter_stay_as_they_are(shape):
    curve = curves.read(shape)
    assert smooth_path(curve) == (curve, None)


def test_corners_are_no_jitter():
    curve = curves.from_points(np.array([[0, 0], [0, 3], [0.8, 0.2], [1.2, 3]]), closed=False)
    assert smooth_path(curve) == (curve, None)


def test_a_given_width_is_obeyed_and_zero_is_none():
    drawn = jittered(curves.line(length=5))
    assert smooth_path(drawn, 0.0) == (drawn, None)
    wide, note = smooth_path(curves.read("s:6"), 0.5)
    assert wide.length < 9.2
    assert "over 50 cm" in note
