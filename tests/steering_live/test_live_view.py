"""What is seen in the live viewer: a camera that follows smoothly, everybody in view beside the panel, and marks."""

import itertools
import math

import numpy as np
import pytest
import viser
from hypothesis import given
from hypothesis import strategies as st
from stage import run

from mapctl.mesh import colours
from scenes.live.bodies.tracks import build_arrow, build_tail
from scenes.live.view import scenery
from scenes.live.view.chase import CameraMode, ChaseCamera, facing_of, turn_about_up
from scenes.live.view.framing import Box, bound_characters, find_free_part, frame_characters, project
from scenes.live.view.themes import DARK, LIGHT

PANEL = 340.0
SIZES = [(700, 620), (1280, 760), (1920, 1080)]


def row(count: int) -> np.ndarray:
    return np.stack([1.5 * (np.arange(count) - (count - 1) / 2), np.zeros(count)], axis=-1)


def overlap(a: Box, b: Box) -> bool:
    across = min(a.left + a.width, b.left + b.width) > max(a.left, b.left)
    return across and min(a.top + a.height, b.top + b.height) > max(a.top, b.top)


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize(("count", "least"), [(1, 0.3), (4, 0.15)])
@pytest.mark.parametrize("where", ["right", "left", "top", "docked", None])
def test_all_characters_are_in_view_beside_the_panel_and_large_enough(size, count, least, where):
    width, height = size
    panels = {
        "right": Box(width - PANEL - 15, 15, PANEL, height - 30),
        "left": Box(15, 15, PANEL, height - 30),
        "top": Box(10, 0, width - 20, height / 3),
    }
    panel = panels.get(where)
    canvas = (width - PANEL, height) if where == "docked" else size
    framing = frame_characters(row(count), canvas, panel)
    boxes = bound_characters(framing, row(count), canvas)
    assert len(boxes) == count
    for box in boxes:
        assert panel is None or not overlap(box, panel)
        assert box.left >= 0
        assert box.left + box.width <= canvas[0]
        assert box.top >= 0
        assert box.top + box.height <= height
        assert box.height > least * height
    boxes.sort(key=lambda box: box.left)
    apart = [b.left - a.left > 0.6 * a.width for a, b in itertools.pairwise(boxes)]
    assert all(apart), "nobody hides behind another"


def test_the_free_part_is_what_the_panel_leaves():
    assert find_free_part(700, 600, None) == Box(0, 0, 700, 600)
    assert find_free_part(700, 600, Box(400, 10, 290, 500)) == Box(0, 0, 400, 600)
    assert find_free_part(700, 600, Box(0, 0, 300, 600)) == Box(300, 0, 400, 600)
    assert find_free_part(700, 600, Box(0, 0, 700, 200)) == Box(0, 200, 700, 400)
    assert find_free_part(700, 600, Box(700, 0, 300, 600)) == Box(0, 0, 700, 600), "docked beside it"


def test_who_is_framed_is_seen_from_behind_and_above():
    framing = frame_characters(row(1), (900, 700))
    assert framing.position[2] < -2, "characters begin facing +Z"
    assert framing.position[1] > 1
    middle = project(framing, np.array([0.0, 0.9, 0.0]), (900, 700))
    assert abs(middle[0] - 450) < 60


def follow(chase: ChaseCamera, seconds: float, speed: float, heading: float, *, sway: float = 0.0) -> np.ndarray:
    """Walk on from where the camera is; the errors of its place, (frames,) metres."""
    place, missed = chase._last.copy(), []
    for k in range(round(60 * seconds)):
        place = place + speed / 60 * np.array([math.sin(heading), math.cos(heading)])
        chase.step(1 / 60, place, heading + sway * math.sin(2 * math.pi * k / 60))
        missed.append(float(np.linalg.norm(chase.place - place)))
    return np.array(missed)


def test_it_does_not_lag_at_an_even_pace_and_moves_softly():
    chase = ChaseCamera()
    chase.jump(np.zeros(2), 0.0)
    missed = follow(chase, 4, 2.0, 0.0)
    assert missed.max() < 0.3
    assert missed[-1] < 0.04, "what it goes in a frame"


def test_it_turns_behind_the_character_without_overshooting_or_rocking_with_the_stride():
    chase = ChaseCamera()
    chase.jump(np.zeros(2), 0.0)
    yaws = []
    for _ in range(60):
        follow(chase, 0.1, 1.2, math.pi / 2)
        yaws.append(chase.yaw)
    steps = np.diff(yaws)
    assert steps.min() > -1e-6, "it never turns back"
    assert steps.max() < math.radians(12), "at most 120 degrees a second"
    assert chase.yaw == pytest.approx(math.pi / 2, abs=0.02)
    rocked = []
    for _ in range(40):
        follow(chase, 0.1, 1.2, math.pi / 2, sway=math.radians(12))
        rocked.append(chase.yaw)
    assert np.ptp(rocked[20:]) < math.radians(3)


def test_who_walks_at_the_camera_is_not_swung_round_at_once():
    chase = ChaseCamera()
    chase.jump(np.zeros(2), 0.0)
    follow(chase, 1.0, 1.2, math.pi - 0.02)
    assert abs(chase.yaw) < math.radians(10)


def test_following_does_not_turn_and_staying_does_not_move():
    chase = ChaseCamera()
    chase.jump(np.zeros(2), 0.0)
    chase.mode = CameraMode.FOLLOW
    follow(chase, 2, 1.2, 1.0)
    assert chase.yaw == 0.0
    assert np.linalg.norm(chase.place) > 1.5
    chase.mode = CameraMode.FREE
    at = chase.place.copy()
    follow(chase, 1, 1.2, 1.0)
    np.testing.assert_array_equal(chase.place, at)


def test_who_is_put_elsewhere_is_there_at_once_and_another_one_is_glided_to():
    chase = ChaseCamera()
    chase.jump(np.zeros(2), 0.0)
    chase.step(1 / 60, np.array([5.0, 0.0]), 1.0)
    np.testing.assert_allclose(chase.place, [5, 0], atol=0.1)
    chase.go_over(np.array([9.0, 0.0]))
    chase.step(1 / 60, np.array([9.0, 0.0]), 1.0)
    assert chase.place[0] < 5.5
    for _ in range(240):
        chase.step(1 / 60, np.array([9.0, 0.0]), 1.0)
    np.testing.assert_allclose(chase.place, [9, 0], atol=0.01)


@given(st.floats(-7, 7), st.tuples(st.floats(-50, 50), st.floats(-50, 50)))
def test_what_is_shown_is_found_again_and_the_node_says_the_same(yaw, place):
    chase = ChaseCamera()
    chase.jump(np.array(place), yaw)
    points = np.array([[1.0, 2.0, 3.0], [-4.0, 0.0, 2.0]])
    np.testing.assert_allclose(chase.locate(chase.show(points)), points, atol=1e-9)
    w, x, y, z = chase.wxyz
    node = viser.transforms.SO3(np.array([w, x, y, z])).apply(points) + chase.position
    np.testing.assert_allclose(node, chase.show(points), atol=1e-9)
    ahead = chase.show(np.array(place)[[0, 0, 1]] * [1, 0, 1] + [math.sin(yaw), 0, math.cos(yaw)])
    np.testing.assert_allclose(ahead, [0, 0, 1], atol=1e-9)
    np.testing.assert_allclose(chase.direct(np.array([0.0, 0, 1])), [math.sin(yaw), 0, math.cos(yaw)], atol=1e-9)


def test_facing_is_that_of_the_hips():
    for angle in (-2.0, 0.3, 3.0):
        quat = np.array([0.0, math.sin(angle / 2), 0.0, math.cos(angle / 2)])
        assert facing_of(quat) == pytest.approx(angle)
        np.testing.assert_allclose(
            turn_about_up(np.array([0.0, 0, 1]), angle)[[0, 2]], [math.sin(angle), math.cos(angle)]
        )


def test_an_arrow_points_along_its_way_and_a_tail_begins_as_a_point():
    way = np.stack([np.linspace(0, 1, 30), np.zeros(30)], axis=-1)
    edges = build_arrow(way, 0.1)
    np.testing.assert_allclose(edges[-2:], [[1, 0], [1, 0]], atol=1e-9)
    widths = np.linalg.norm(edges[::2] - edges[1::2], axis=1)
    assert widths[:-2] == pytest.approx(0.1)
    assert widths[-2] > 0.2
    tail = build_tail(way)
    np.testing.assert_allclose(tail[:2], 0, atol=1e-9)
    assert np.linalg.norm(tail[-2] - tail[-1]) > 0.02
    assert build_arrow(way * 0.01, 0.1) is None
    assert build_tail(way[:1]) is None


@pytest.mark.parametrize("theme", [LIGHT, DARK])
def test_the_sky_meets_the_ground_and_the_ground_is_never_white(theme):
    sky = scenery.paint_sky(theme) / 255
    np.testing.assert_allclose(sky[-1, 0], colours.rgb(theme.horizon), atol=0.01)
    np.testing.assert_allclose(sky[0, 0], colours.rgb(theme.zenith), atol=0.01)
    assert np.linalg.norm(colours.rgb(theme.floor) - 1) > 0.1
    assert (sky[0, 0].mean() < 0.3) == theme.dark


@pytest.mark.slow
def test_a_theme_is_chosen_and_auto_is_the_browsers(show):
    director = show._view._director
    show._view.set_theme("dark")
    run(show, 1)
    assert director._dark
    show._view.set_theme("auto")
    show._view.set_theme("pink")
    run(show, 1)
    assert not director._dark
    assert director._choice == "auto"


def test_several_are_followed_and_one_is_chased(show):
    assert show._view.mode is CameraMode.FOLLOW
    assert show._panel.viewing.camera.value == CameraMode.FOLLOW.value


def test_marks_are_hidden_and_shown(show):
    run(show, 3)
    tracks = show._cast.members[0].tracks
    assert tracks._node.visible
    show._view.show_marks(False)
    run(show, 1)
    assert not tracks._node.visible
