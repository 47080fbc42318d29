"""Paths of the live viewer: points that are edited, files that are written and read, and what is no path."""

import numpy as np
import pytest
from stage import run

from mapctl import curves
from mapctl.errors import MapctlError, RequestError
from scenes.live import paths
from scenes.live.paths import MAX_POINTS, PathPoints, hits_ball, make_curve, read_path, sample_curve, write_csv

SQUARE = [(0.0, 0.0), (2.0, 0.0), (2.0, 2.0), (0.0, 2.0)]
DOWN = (0.0, -1.0, 0.0)


def square(**more) -> PathPoints:
    return PathPoints(list(SQUARE), **more)


def distances(curve, points) -> np.ndarray:
    vertices = curve.points.numpy()
    return np.array([np.linalg.norm(vertices - np.array(point), axis=1).min() for point in points])


def test_points_are_moved_inserted_and_removed():
    path = square()
    path.move(1, 3.0, -1.0)
    path.insert(1, 2.5, 1.0)
    assert path.points == [(0.0, 0.0), (3.0, -1.0), (2.5, 1.0), (2.0, 2.0), (0.0, 2.0)]
    path.remove(2)
    path.remove(0)
    assert path.points == [(3.0, -1.0), (2.0, 2.0), (0.0, 2.0)]
    path.move(7, 0.0, 0.0)
    path.insert(7, 0.0, 0.0)
    path.remove(7)
    assert len(path.points) == 3, "of a browser that does not know yet that a point is gone"


@pytest.mark.parametrize("closed", [False, True])
def test_midpoints_are_on_the_curve_each_between_its_points(closed):
    path = square(is_closed=closed)
    between = path.midpoints()
    assert len(between) == 3 + closed
    assert distances(path.curve, between).max() < 0.01
    for number, point in enumerate(between):
        ends = SQUARE[number], SQUARE[(number + 1) % 4]
        assert all(0.8 < np.linalg.norm(np.array(point) - end) < 1.5 for end in ends)
    crossing = PathPoints([(0.0, 0.0), (2.0, 0.0), (2.0, 2.0), (0.0, 0.0), (-2.0, 0.0)])
    assert np.hypot(*crossing.midpoints()[-1] - np.array([-1.0, 0.0])) < 0.3
    assert PathPoints([(1.0, 1.0), (1.0, 1.0)]).midpoints() == []


@pytest.mark.parametrize("closed", [False, True])
def test_what_is_written_is_what_follow_reads_and_comes_back_in_few_points(closed, tmp_path):
    path = square(is_closed=closed)
    table = tmp_path / "path.csv"
    table.write_bytes(write_csv(path.curve))
    read = curves.read(table)
    assert (read.closed, read.length) == (closed, pytest.approx(path.curve.length, rel=1e-3))
    found, _ = read_path("path.csv", table.read_bytes())
    assert found.is_closed == closed
    assert len(found.points) <= 8
    assert distances(found.curve, sample_curve(path.curve)).max() <= 0.025


def test_few_points_are_taken_as_they_are_and_many_become_fewer():
    few, note = read_path("x.CSV", b"x;z\n0;0\n1,5;0\n1,5;2\n")
    assert (few.points, few.is_closed, note) == ([(0.0, 0.0), (1.5, 0.0), (1.5, 2.0)], False, "")
    turn = np.linspace(0, 2 * np.pi, 10_000)
    eight = np.stack([5 * np.sin(turn), 5 * np.cos(turn) * np.sin(2 * turn)], axis=1)
    found, note = read_path("x.csv", "\n".join(f"{x},{z}" for x, z in eight).encode())
    assert found.is_closed
    assert len(found.points) < 100
    assert note.startswith(f"9999 points became {len(found.points)}; the curve is at most ")
    assert distances(make_curve(found.points, closed=True), eight[::50]).max() <= 0.021


def test_a_drawing_is_read():
    found, _ = read_path("d.svg", b'<svg><path d="M 0 0 C 100 0 200 100 200 200 L 200 400"/></svg>')
    assert found.points[0] == pytest.approx((0.0, 0.0), abs=1e-6)
    assert found.points[-1] == pytest.approx((2.0, 4.0), abs=1e-6)


@pytest.mark.parametrize(
    ("name", "content", "said"),
    [
        ("a.csv", b"1,2\n", "2 to 1000000 points, got 1"),
        ("a.csv", b"", "a.csv: the file is empty"),
        ("a.csv", b"0,0\nnan,1\n", "a.csv, line 2: expected a number"),
        ("a.csv", b"\0\1\2\xff" * 99, "not a text file"),
        ("a.csv", b"0,0\n5000,0\n", "more than 1000 m from the origin"),
        ("a.svg", b"<svg", "cannot be read as an SVG"),
        ("a.svg", b"<svg></svg>", "no drawn path"),
        ("walk.bvh", b"HIERARCHY", r"\.csv.*files, not from 'walk.bvh'"),
        ("../../x.csv/..", b"0,0\n1,1", "not from"),
        ("a.csv", b"0,0\n" * 3_000_000, "11 MiB; a path has at most 8"),
    ],
)
def test_files_that_are_no_paths_are_refused_in_a_line(name, content, said):
    with pytest.raises(MapctlError, match=said) as refused:
        read_path(name, content)
    assert "/tmp" not in str(refused.value)


def test_points_that_are_far_away_are_refused_and_nothing_changes():
    path = square()
    path.move(0, -1000.0, 1000.0)
    for x, z in ((1000.1, 0.0), (np.nan, 0.0), (np.inf, 0.0)):
        for change in (path.add, lambda x, z: path.insert(0, x, z), lambda x, z: path.move(1, x, z)):
            with pytest.raises(RequestError, match="more than 1000 m from the origin"):
                change(x, z)
    with pytest.raises(RequestError, match="m long; allowed are 5000 m"):
        path.replace([(0.0, 1000.0 * (-1) ** k) for k in range(9)], closed=False)
    with pytest.raises(RequestError, match="at most 200 points"):
        path.replace([(0.01 * k, 0.0) for k in range(MAX_POINTS + 1)], closed=False)
    assert path.points == [(-1000.0, 1000.0), *SQUARE[1:]]


def test_clicks_on_balls_are_none_on_the_ground():
    assert hits_ball(SQUARE, np.array([[2.05, 2.0, 0.0], DOWN]))
    assert not hits_ball(SQUARE, np.array([[1.0, 2.0, 0.0], DOWN]))
    assert not hits_ball([], np.array([[0.0, 2.0, 0.0], DOWN]))


def test_the_editor_does_what_is_dragged_and_explains_what_is_impossible(show, monkeypatch):
    monkeypatch.setattr(show.view, "to_world_ray", lambda ray: ray)
    editor = show.path

    def text() -> str:
        run(show, 3)
        return show.panel.path.content

    for x, z in (*SQUARE, (2.05, 0.0)):
        editor.add(x, z, np.array([[x, 2.0, z], DOWN]))
    assert text() == "4 points, 6.3 m."
    np.testing.assert_allclose(editor._points.handle.batched_positions[:, ::2], SQUARE)
    for phase, x in (("start", 3.0), ("update", 3.5), ("end", 9.0)):
        editor._drag(1, phase, ((x, 2.0, -1.0), DOWN))
    text()
    assert editor.path.points[1] == (3.5, -1.0), "where a drag ends the mouse may be anywhere"
    editor.close(True)
    for phase, x in (("start", -1.0), ("update", -1.2), ("end", -1.2)):
        editor._insert(3, phase, ((x, 2.0, 1.0), DOWN))
    assert text().startswith("5 points")
    assert editor.path.points[4] == (-1.2, 1.0)
    assert show.panel.closed.value is True
    assert len(editor._between.handle.batched_positions) == 5
    editor._click(4)
    editor._click(99)
    assert text().startswith("4 points")
    editor.load("b.csv", b"1,1")
    assert "⚠️" in text()
    assert len(editor.path.points) == 4
    editor.load("a.csv", b"0,0\n2,0\n2,2\n")
    assert text().startswith("3 points")
    editor.clear()
    assert text() == paths.HELP
    assert editor._line is None
    with pytest.raises(RequestError, match="2 points or more"):
        show.download_path(None)
