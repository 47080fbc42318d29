"""What lies on the ground: in the right place, of the right size, and fading away."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mapctl.mesh import colours
from scenes import overlays


def area(surface) -> float:
    a, b, c = np.moveaxis(surface.vertices[surface.faces], 1, 0)
    return float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2)


@settings(max_examples=30)
@given(st.floats(0.5, 4.0), st.floats(0.02, 0.3))
def test_a_ribbon_has_the_area_of_its_length_times_its_width(radius, width):
    turn = np.linspace(0, 2 * np.pi, 400)
    ring = overlays.build_ribbon(
        radius * np.stack([np.sin(turn), np.cos(turn)], 1), width=width, rgb=np.ones(3), height=0.01
    )
    assert area(ring) == pytest.approx(2 * np.pi * radius * width, rel=0.01)
    assert (ring.vertices[:, 1] == 0.01).all()


def test_all_flat_surfaces_face_up():
    surfaces = [
        overlays.build_ribbon(np.array([[0.0, 0.0], [0.3, 1.0]]), width=0.1, rgb=np.ones(3), height=0.0),
        overlays.build_discs(np.zeros((1, 2)), np.ones((1, 3))),
        overlays.build_arrow(np.zeros(2), 0.7, np.ones(3), length=0.5),
        overlays.build_grid(np.zeros((1, 2))),
        overlays.build_shadow(np.array([[[0.0, 0.1, 0.0], [0.0, 1.0, 0.0]]]), np.array([0.1])),
    ]
    for surface in surfaces:
        a, b, c = np.moveaxis(surface.vertices[surface.faces], 1, 0)
        assert (np.cross(b - a, c - a)[:, 1] > 0).all()


def test_the_grid_has_squares_of_a_metre_and_fades_into_the_background():
    grid = overlays.build_grid(np.array([[0.3, -0.2]]))
    tiles = grid.vertices[grid.vertices[:, 1] == overlays.TILE_HEIGHT]
    assert tiles[:, [0, 2]] == pytest.approx(np.round(tiles[:, [0, 2]]), abs=1e-9)
    assert np.ptp(tiles.reshape(-1, 4, 3), axis=1)[:, [0, 2]] == pytest.approx(1.0)
    distance = np.linalg.norm(grid.vertices[:, [0, 2]] - [0.3, -0.2], axis=1)
    contrast = np.abs(grid.rgba[:, :3] - colours.rgb(colours.BACKGROUND)).max(axis=1)
    assert contrast[distance > 6.6].max() < 1e-9
    assert contrast[distance < 1.5].max() > 0.2


def test_a_shadow_lies_where_the_light_throws_it_and_is_sharper_below():
    def darkest(height: float):
        ball = np.array([[[1.0, height, 2.0], [1.0, height, 2.0]]])
        shade = overlays.build_shadow(ball, np.array([0.08]))
        peak = shade.rgba[:, 3].max()
        return shade.vertices[shade.rgba[:, 3] > 0.98 * peak][:, [0, 2]].mean(axis=0), peak

    low, low_peak = darkest(0.1)
    high, high_peak = darkest(1.5)
    fall = overlays.LIGHT[[0, 2]] / -overlays.LIGHT[1]
    assert low == pytest.approx(np.array([1.0, 2.0]) + 0.1 * fall, abs=0.03)
    assert high == pytest.approx(np.array([1.0, 2.0]) + 1.5 * fall, abs=0.08)
    assert low_peak > 1.5 * high_peak > 0
