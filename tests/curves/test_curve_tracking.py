"""Where a walk is on its curve, on walks whose arcs are known because they were made from them."""

import math

import numpy as np
import pytest
import torch
from helpers import walk_through

from mapctl import curves
from mapctl.curves.tracking import track_arcs
from mapctl.metrics import measure

FPS = 30


def hairpin(*, apart: float, leg: float = 4.0) -> curves.Curve:
    """Out and back beside the way out; `apart` 0 is back on the very same line."""
    turn = np.linspace(0, math.pi, 40)
    bend = np.stack([apart / 2 * (1 - np.cos(turn)), leg + apart / 2 * np.sin(turn)], axis=1)
    return curves.from_points(np.concatenate([[[0.0, 0.0]], bend, [[apart, 0.0]]]))


CURVES = {
    "hairpin": hairpin(apart=0.3),
    "narrow hairpin": hairpin(apart=0.1),
    "back on itself": hairpin(apart=0.0),
    "figure8": curves.figure8(radius=1.0),
    "circle": curves.circle(radius=1.5),
    "two laps drawn": curves.from_points(np.stack([f(np.linspace(0, 4 * math.pi, 800)) for f in (np.sin, np.cos)], 1)),
}
LAPS = {"circle": 2.4, "figure8": 2.4}


def result(curve, *, laps=1.0, sway=0.03, speed=1.3, fps=FPS, seed=0):
    """Arcs that go on evenly, and places beside them: hips that sway."""
    length = laps * curve.length
    arcs = torch.linspace(0, length, round(length / speed * fps), dtype=torch.float64)
    phase = 2 * math.pi * torch.rand(1, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    offset = sway * torch.sin(2 * math.pi * torch.arange(len(arcs)) / fps + phase)
    return arcs, offset, curve.point(arcs) + offset[:, None] * curve.left(arcs)


@pytest.mark.parametrize("name", CURVES)
@pytest.mark.parametrize("fps", [30, 120])
def test_arcs_are_those_of_the_generated_walk(name, fps):
    curve = CURVES[name]
    arcs, _, positions = result(curve, laps=LAPS.get(name, 1.0), fps=fps)
    found = track_arcs(curve, positions)
    assert float((found - arcs).abs().max()) < 0.12  # near a tip the other leg is as near
    assert float((found - arcs).abs().median()) < 0.005
    assert float(found[-1] - found[0]) == pytest.approx(float(arcs[-1]), abs=0.12)


@pytest.mark.parametrize("name", CURVES)
def test_progress_and_path_error_are_the_walks_own(name):
    curve = CURVES[name]
    arcs, offset, positions = result(curve, laps=LAPS.get(name, 1.0))
    got = measure(walk_through(positions, fps=FPS), curve, speed=1.3)
    assert got["travelled_m"] == pytest.approx(float(arcs[-1]), rel=0.02)
    assert got["progress_ratio"] == pytest.approx(1, abs=0.03)
    own = 100 * offset.abs()
    assert got["path_error_mean_cm"] == pytest.approx(float(own.mean()), abs=0.1)
    assert got["path_error_max_cm"] == pytest.approx(float(own.max()), abs=0.3)
    for kind in ("mean", "max"):
        assert got[f"path_error_low_passed_{kind}_cm"] < got[f"path_error_{kind}_cm"]


def test_steps_back_and_standing_are_followed():
    """To and fro by 0.4 m on a line: the nearest place is the truth there."""
    z = 2 + np.concatenate([np.linspace(0, 1, 30), np.linspace(1, 0.6, 20), np.full(40, 0.6), np.linspace(0.6, 2, 40)])
    line = curves.line(length=10.0)
    found = track_arcs(line, torch.tensor(np.stack([0.02 * np.sin(z), z], axis=1)))
    np.testing.assert_allclose(found.numpy(), z, atol=1e-6)
