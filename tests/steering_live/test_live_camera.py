"""The camera of the live viewer follows smoothly and frames all characters."""

import math

import numpy as np
import pytest
import viser
from hypothesis import given
from hypothesis import strategies as st

from scenes.cameras import View, look_at
from scenes.live.camera import FOV, CameraMode, ChaseCamera, frame_characters, turn_about_up


@pytest.mark.parametrize("size", [(400, 620), (940, 760), (1580, 1080)])
@pytest.mark.parametrize(("count", "least"), [(1, 0.25), (4, 0.1)])
def test_all_characters_are_in_view_from_behind_and_large_enough(size, count, least):
    positions = np.stack([1.5 * (np.arange(count) - (count - 1) / 2), np.zeros(count)], axis=-1)
    eye, target = frame_characters(positions, size[0] / size[1])
    assert eye[2] < -2, "characters begin facing +Z"
    assert eye[1] > 1
    view = View(look_at(eye, target), FOV, *size)
    middles = []
    for x, z in positions:
        corners = np.array([[x + dx, y, z + dz] for dx in (-0.4, 0.4) for y in (0, 1.8) for dz in (-0.5, 0.5)])
        flat = view.project(corners)[:, :2]
        assert (flat > 0).all()
        assert (flat < size).all()
        assert np.ptp(flat[:, 1]) > least * min(size)
        middles.append(flat[:, 0].mean())
    assert np.abs(np.diff(sorted(middles))).min(initial=np.inf) > 20, "none hides behind another"


def follow(chase: ChaseCamera, seconds: float, speed: float, heading: float, *, sway: float = 0.0) -> np.ndarray:
    """Walk on from where the camera is; the errors of its position, (frames,) metres."""
    position, missed = chase._last.copy(), []
    for k in range(round(60 * seconds)):
        position = position + speed / 60 * np.array([math.sin(heading), math.cos(heading)])
        chase.step(1 / 60, position, heading + sway * math.sin(2 * math.pi * k / 60))
        missed.append(float(np.linalg.norm(chase.position - position)))
    return np.array(missed)


@pytest.fixture
def chase() -> ChaseCamera:
    camera = ChaseCamera()
    camera.jump(np.zeros(2), 0.0)
    return camera


def test_it_does_not_lag_at_an_even_pace_and_moves_softly(chase):
    missed = follow(chase, 4, 2.0, 0.0)
    assert missed.max() < 0.3
    assert missed[-1] < 0.04


def test_it_turns_behind_the_character_without_overshooting_or_rocking_with_the_stride(chase):
    yaws = []
    for _ in range(60):
        follow(chase, 0.1, 1.2, math.pi / 2)
        yaws.append(chase.yaw)
    steps = np.diff(yaws)
    assert -1e-6 < steps.min() <= steps.max() < math.radians(12), "at most 120 degrees a second, never back"
    assert chase.yaw == pytest.approx(math.pi / 2, abs=0.02)
    rocked = []
    for _ in range(40):
        follow(chase, 0.1, 1.2, math.pi / 2, sway=math.radians(12))
        rocked.append(chase.yaw)
    assert np.ptp(rocked[20:]) < math.radians(3)


def test_following_does_not_turn_and_staying_does_not_move(chase):
    chase.mode = CameraMode.FOLLOW
    follow(chase, 2, 1.2, 1.0)
    assert chase.yaw == 0.0
    assert np.linalg.norm(chase.position) > 1.5
    chase.mode = CameraMode.FREE
    at = chase.position.copy()
    follow(chase, 1, 1.2, 1.0)
    np.testing.assert_array_equal(chase.position, at)


@given(st.floats(-7, 7), st.tuples(st.floats(-50, 50), st.floats(-50, 50)))
def test_views_and_world_are_inverse_and_a_chased_character_looks_away(yaw, position):
    chase = ChaseCamera()
    chase.jump(np.array(position), yaw)
    points = np.array([[1.0, 2.0, 3.0], [-4.0, 0.0, 2.0]])
    np.testing.assert_allclose(chase.to_world(chase.to_view(points)), points, atol=1e-9)
    ahead = chase.to_view(np.array(position)[[0, 0, 1]] * [1, 0, 1] + [math.sin(yaw), 0, math.cos(yaw)])
    np.testing.assert_allclose(ahead, [0, 0, 1], atol=1e-9)


def test_the_node_of_the_world_is_where_the_camera_shows_points(show):
    chase, points = show.view.chase, np.array([[1.0, 2.0, 3.0], [-4.0, 0.0, 2.0]])
    chase.mode = CameraMode.FREE
    chase.position, chase.yaw = np.array([2.0, -1.0]), 0.7
    show.view.step(0.0, np.zeros(2), 0.0)
    node = show.view._world
    shown = viser.transforms.SO3(np.array(node.wxyz)).apply(points) + node.position
    np.testing.assert_allclose(shown, chase.to_view(points), atol=1e-4)
    look = np.asarray(show.server.initial_camera.look_at) - np.asarray(show.server.initial_camera.position)
    away = turn_about_up(look, chase.yaw)
    heading = show.view.find_heading((0.0, 1.0), None)
    assert heading == pytest.approx(math.atan2(away[0], away[2]))


def test_points_turn_as_headings_do():
    for angle in (-2.0, 0.3, 3.0):
        turned = turn_about_up(np.array([0.0, 0, 1]), angle)
        np.testing.assert_allclose(turned[[0, 2]], [math.sin(angle), math.cos(angle)])
