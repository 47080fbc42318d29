"""Detours: clear of what is in the way, on the curve elsewhere, and none where no way leads through."""

import pytest
import torch

from controllers.shots.trajectory import apply_detour, find_detour
from mapctl import curves
from mapctl.curves.obstacles import Obstacle, measure_clearance

MARGIN = 0.35
LINE = curves.line(length=9)


def lead_around(curve, *obstacles):
    offsets = find_detour(curve, lambda points, _: measure_clearance(obstacles, points) - MARGIN)
    return None if offsets is None else apply_detour(curve, offsets)


def points_of(curve):
    return curve.point(torch.linspace(0, curve.length, 900, dtype=torch.float64))


@pytest.mark.slow
@pytest.mark.parametrize(
    "obstacles",
    [
        (Obstacle((0.05, 4.5), 0.5),),
        (Obstacle((0.3, 3.0), size=(1.0, 0.3), turn_deg=30),),
        (Obstacle((0.3, 3.0), 0.4), Obstacle((-0.3, 5.2), 0.4)),
    ],
    ids=["disc", "box", "slalom"],
)
@pytest.mark.parametrize("curve", [LINE, curves.wave(amplitude=0.3, length=9)], ids=["line", "wave"])
def test_a_detour_is_clear_and_the_curve_itself_far_away(curve, obstacles):
    detour = lead_around(curve, *obstacles)
    found = points_of(detour)
    clear = measure_clearance(obstacles, found)
    assert float(clear.amin()) > MARGIN - 0.03
    off = (found - curve.point(curve.nearest(found))).norm(dim=-1)
    assert float(off[clear > 1.8].max()) < 0.06
    torch.testing.assert_close(found[0], curve.start, atol=1e-5, rtol=0)
    assert not detour.closed


def test_a_curve_that_is_clear_stays_as_it_is():
    assert lead_around(LINE, Obstacle((3.0, 4.5), 0.5)) is LINE


def test_none_where_no_way_leads_through():
    assert lead_around(LINE, Obstacle((0.0, 4.5), size=(20.0, 0.2))) is None
    assert lead_around(LINE, Obstacle((0.0, 0.1), 0.3)) is None  # the start itself
