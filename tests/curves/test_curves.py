"""Curves: geometry against closed forms, search against brute force, impossible requests."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from mapctl import curves
from mapctl.errors import RequestError

ARCS = torch.linspace(0, 30, 301, dtype=torch.float64)


def brute_force(points, polyline):
    """Distance and arc of the nearest place on a polyline, over all of its pieces (numpy)."""
    start, along = polyline[:-1], np.diff(polyline, axis=0)
    length = np.linalg.norm(along, axis=1)
    share = np.clip(((points[:, None] - start) * along).sum(-1) / length**2, 0, 1)
    distance = np.linalg.norm(points[:, None] - start - share[..., None] * along, axis=-1)
    best, row = distance.argmin(1), np.arange(len(points))
    return distance[row, best], (np.cumsum(length) - length)[best] + share[row, best] * length[best]


@pytest.mark.parametrize("radius", [0.01, 0.3, 4.0, 250.0])
def test_circle_is_round_turns_left_and_wraps(radius):
    curve = curves.circle(radius=radius)
    angle = ARCS / radius
    expected = radius * torch.stack([1 - torch.cos(angle), torch.sin(angle)], dim=-1)
    assert curve.closed
    assert curve.length == pytest.approx(2 * math.pi * radius, rel=1e-4)
    laps = ARCS * (curve.length / (2 * math.pi * radius))
    torch.testing.assert_close(curve.point(laps), expected, rtol=0, atol=1e-4 * radius + 1e-5)
    torch.testing.assert_close(
        curve.tangent(laps), torch.stack([torch.sin(angle), torch.cos(angle)], dim=-1), rtol=0, atol=0.02
    )
    torch.testing.assert_close(curve.curvature(ARCS), torch.full_like(ARCS, 1 / radius), rtol=0.02, atol=1e-3)
    assert curve.start_heading == pytest.approx(0, abs=0.02)


def test_s_line_and_wave_have_the_asked_sizes():
    s, line, wave = curves.s(length=6.0), curves.line(length=10.0), curves.wave(amplitude=1.5, length=8.0)
    assert float((s.points[-1] - s.points[0]).norm()) == pytest.approx(6.0, abs=1e-9)
    assert s.length == pytest.approx(3 * math.pi, rel=1e-4)
    assert float(s.curvature(1.0)) > 0.5
    assert float(s.curvature(s.length - 1.0)) < -0.5
    assert line.points[-1].tolist() == [0.0, 10.0]
    assert line.length == pytest.approx(10.0)
    assert wave.points[-1].tolist() == pytest.approx([0.0, 8.0])
    assert float(wave.points[:, 0].max()) == pytest.approx(1.5, abs=1e-5)
    assert wave.start_heading == pytest.approx(math.atan2(1.5 * 2 * math.pi / 8, 1), abs=0.02)
    assert not any(curve.closed for curve in (s, line, wave))


def test_a_curve_through_points_passes_them_smoothly_and_few_points_are_a_line():
    points = np.array([[0.0, 0.0], [1.0, 0.2], [1.2, 0.1], [1.2, 0.1], [3.0, 2.0]])
    curve = curves.through(points)
    sharp = curves.from_points(points)
    dense = torch.linspace(0, curve.length, 400).double()
    for point in points:
        assert float((curve.point(dense) - torch.tensor(point)).norm(dim=-1).min()) < 0.02
    turns = [
        torch.diff(c.tangent(torch.linspace(0.1, c.length - 0.1, 300).double()), dim=0).norm(dim=-1).max()
        for c in (curve, sharp)
    ]
    assert turns[0] < turns[1] / 2
    assert curves.through(points[:2]).length == pytest.approx(float(np.hypot(1.0, 0.2)))
    with pytest.raises(RequestError, match="at least 2"):
        curves.through(points[2:4])


@settings(max_examples=40)
@given(st.integers(0, 10_000), st.sampled_from([2, 3]), st.integers(2, 12))
def test_any_drawing_keeps_its_points_its_length_and_its_nearest_places(seed, dims, count):
    rng = np.random.default_rng(seed)
    drawn = rng.normal(size=(count, dims)) * 2
    curve = curves.from_points(drawn, closed=False)
    assert curve.length == pytest.approx(np.linalg.norm(np.diff(drawn, axis=0), axis=1).sum(), rel=1e-9)
    assert curve.points.diff(dim=0).norm(dim=-1).max() <= 0.010001
    for point in drawn:
        assert np.linalg.norm(curve.points.numpy() - point, axis=1).min() < 1e-9
    positions = rng.normal(size=(30, dims)) * 3
    distance, arc = brute_force(positions, drawn)
    found = curve.nearest(torch.tensor(positions))
    gap = (curve.point(found) - torch.tensor(positions)).norm(dim=-1).numpy()
    np.testing.assert_allclose(gap, distance, atol=2e-5)
    local = curve.nearest(torch.tensor(positions), around=torch.tensor(arc) + 0.1, reach=0.3)
    gap = (curve.point(local) - torch.tensor(positions)).norm(dim=-1).numpy()
    inside = (arc > 0.5) & (arc < curve.length - 0.5)  # else the search meets the straight extension
    np.testing.assert_allclose(gap[inside], distance[inside], atol=1e-4)
    assert (gap <= distance + 1e-4).all()


def test_gradients_of_places_and_of_searches():
    curve = curves.wave(amplitude=1.0, length=6.0)
    arcs = torch.tensor([-0.5, 1.2345, 3.3, 40.0], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(curve.point, arcs)
    assert torch.autograd.gradcheck(curve.tangent, arcs)
    positions = (curve.point(arcs) + torch.tensor([0.1, -0.03])).detach().requires_grad_()

    def offset(at):
        return curve.signed_offset(at, curve.nearest(at, around=arcs.detach()))

    numeric = torch.autograd.functional.jacobian(offset, positions).sum(1)
    # The sideways offset grows by one to the left whatever the search does.
    torch.testing.assert_close(
        (numeric * curve.left(curve.nearest(positions, around=arcs))).sum(-1), torch.ones(4).double(), rtol=0, atol=0.02
    )


def test_a_curve_in_space_is_followed_in_space():
    curve = curves.from_points(np.array([[0.0, 0.0, 0.0], [0.0, 3.0, 4.0]]))
    assert curve.dims == 3
    torch.testing.assert_close(curve.point(2.5), torch.tensor([0.0, 1.5, 2.0], dtype=torch.float64))
    beside = torch.tensor([[0.2, 1.5, 2.0]], dtype=torch.float64)
    assert float(curve.nearest(beside)) == pytest.approx(2.5)
    assert float(curve.signed_offset(beside, 2.5)) == pytest.approx(0.2)


@pytest.mark.parametrize(
    ("points", "closed"),
    [
        ([[0, 0], [1, 0], [1, 1], [0, 0.0005]], True),  # within 1 mm
        ([[0, 0], [1, 0], [1, 1], [0, 1], [0, 0.4]], True),  # within half the spacing
        ([[0, 0], [1, 0], [1, 1], [0, 1]], False),
        ([[0, 0], [0.4, 0]], False),
    ],
)
def test_a_curve_is_closed_where_its_ends_meet(points, closed):
    curve = curves.from_points(np.array(points))
    assert curve.closed is closed
    assert torch.equal(curve.points[0], curve.points[-1]) is closed
    assert not curves.from_points(np.array(points), closed=False).closed


@pytest.mark.parametrize(
    "points", [np.zeros((0, 2)), np.zeros((5, 2)), np.zeros((5, 4)), [[0, 0], [0, math.nan]], [[0, 0], [0, 0.001]]]
)
def test_points_that_make_no_curve_are_refused(points):
    with pytest.raises(RequestError):
        curves.from_points(np.array(points, dtype=float))


@pytest.mark.parametrize(
    "text", ["circle:0", "circle:nan", "circle:1e9", "circle", "circle:4x2", "wave:0x8", "spiral:3", ""]
)
def test_shapes_that_cannot_be_are_refused_in_one_line(text):
    with pytest.raises(RequestError) as error:
        curves.read(text)
    assert "\n" not in str(error.value)
