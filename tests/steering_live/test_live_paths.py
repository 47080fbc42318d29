"""Paths of the live viewer: points that are edited, files that are written and read, and what is no path."""

import numpy as np
import pytest
from stage import run

from mapctl import curves
from mapctl.errors import MapctlError, RequestError
from scenes.live.paths import files
from scenes.live.paths.points import MAX_POINTS, PathPoints, make_curve, sample_curve

SQUARE = [(0.0, 0.0), (2.0, 0.0), (2.0, 2.0), (0.0, 2.0)]


def square(**more) -> PathPoints:
    return PathPoints(list(SQUARE), **more)


def distances(curve, places) -> np.ndarray:
    vertices = curve.points.numpy()
    return np.array([np.linalg.norm(vertices - np.array(place), axis=1).min() for place in places])


def test_points_are_moved_inserted_and_removed():
    path = square()
    path.move(1, 3.0, -1.0)
    path.insert(1, 2.5, 1.0)
    assert path.points == [(0.0, 0.0), (3.0, -1.0), (2.5, 1.0), (2.0, 2.0), (0.0, 2.0)]
    assert path.selected == 2
    path.remove(path.selected)
    path.remove(0)
    assert path.points == [(3.0, -1.0), (2.0, 2.0), (0.0, 2.0)]
    for wrong in (None, -1, 3):
        with pytest.raises(RequestError, match="no point is selected"):
            path.remove(wrong)
    path.move(7, 0.0, 0.0)
    path.insert(7, 0.0, 0.0)
    assert len(path.points) == 3, "of a browser that has not heard yet that a point is gone"


@pytest.mark.parametrize("closed", [False, True])
def test_places_between_are_on_the_curve_each_between_its_points(closed):
    path = square(is_closed=closed)
    between = path.midpoints()
    assert len(between) == 3 + closed
    assert path.curve is not None
    assert distances(path.curve, between).max() < 0.01
    for number, place in enumerate(between):
        ends = SQUARE[number], SQUARE[(number + 1) % 4]
        assert all(0.8 < np.linalg.norm(np.array(place) - end) < 1.5 for end in ends)


def test_a_path_that_comes_back_to_a_point_has_its_places_in_order():
    path = PathPoints([(0.0, 0.0), (2.0, 0.0), (2.0, 2.0), (0.0, 0.0), (-2.0, 0.0)])
    assert np.hypot(*path.midpoints()[-1] - np.array([-1.0, 0.0])) < 0.3
    assert PathPoints([(1.0, 1.0), (1.0, 1.0)]).midpoints() == []


@pytest.mark.parametrize("closed", [False, True])
def test_what_is_written_is_what_follow_reads_and_comes_back_in_few_points(closed, tmp_path):
    path = square(is_closed=closed)
    assert path.curve is not None
    table = tmp_path / "path.csv"
    table.write_bytes(files.write_csv(path.curve))
    read = curves.read(table)
    assert read.closed == closed
    assert read.length == pytest.approx(path.curve.length, rel=1e-3)
    found = files.read_path("path.csv", table.read_bytes())
    assert found.closed == closed
    assert len(found.points) <= 8
    again = make_curve(found.points, closed=found.closed)
    assert distances(again, sample_curve(path.curve)).max() <= 0.025


@pytest.mark.slow
def test_few_points_are_taken_as_they_are_and_many_become_fewer_as_exact_as_is_said():
    few = files.read_path("x.CSV", b"x;z\n0;0\n1,5;0\n1,5;2\n")
    assert (few.points, few.closed, few.note) == ([(0.0, 0.0), (1.5, 0.0), (1.5, 2.0)], False, "")
    turn = np.linspace(0, 2 * np.pi, 10_000)
    eight = np.stack([5 * np.sin(turn), 5 * np.cos(turn) * np.sin(2 * turn)], axis=1)
    found = files.read_path("x.csv", "\n".join(f"{x},{z}" for x, z in eight).encode())
    assert found.closed
    assert len(found.points) < 100
    assert found.note.startswith(f"9999 points became {len(found.points)} that can be dragged; the curve is at most 2.")
    assert distances(make_curve(found.points, closed=True), eight[::50]).max() <= 0.021
    wild = np.cumsum(np.random.default_rng(0).normal(scale=0.1, size=(10_000, 2)), axis=0)
    found = files.read_path("x.csv", "\n".join(f"{x},{z}" for x, z in wild).encode())
    assert len(found.points) == MAX_POINTS
    assert "10000 points became 200" in found.note


def test_a_drawing_is_read():
    found = files.read_path("d.svg", b'<svg><path d="M 0 0 C 100 0 200 100 200 200 L 200 400"/></svg>')
    assert found.points[0] == pytest.approx((0.0, 0.0), abs=1e-6)
    assert found.points[-1] == pytest.approx((2.0, 4.0), abs=1e-6)


@pytest.mark.parametrize(
    ("name", "content", "said"),
    [
        ("a.csv", b"1,2\n", "2 to 1000000 points, got 1"),
        ("a.csv", b"1,2\n1,2\n", "at least 2 distinct points"),
        ("a.csv", b"", "a.csv: the file is empty"),
        ("a.csv", b"0,0\nnan,1\n", "a.csv, line 2: expected a number"),
        ("a.csv", b"\0\1\2\xff" * 99, "not a text file"),
        ("a.svg", b"<svg", "cannot be read as an SVG"),
        ("a.svg", b"<svg></svg>", "no drawn path"),
        ("walk.bvh", b"HIERARCHY", r"\.csv.*files, not from 'walk.bvh'"),
        ("", b"", "not from ''"),
        ("../../x.csv/..", b"0,0\n1,1", "not from"),
        ("a.csv", b"0,0\n" * 3_000_000, "11 MiB; a path has at most 8"),
    ],
)
def test_files_that_are_no_paths_are_refused_in_a_line(name, content, said):
    with pytest.raises(MapctlError, match=said) as refused:
        files.read_path(name, content)
    assert "/tmp" not in str(refused.value)


@pytest.mark.slow
def test_points_that_are_far_away_are_refused_and_nothing_changes():
    path = square()
    path.move(0, -1000.0, 1000.0)
    for x, z in ((1000.1, 0.0), (0.0, -1e9), (np.nan, 0.0), (np.inf, 0.0)):
        for change in (lambda x=x, z=z: path.add(x, z), lambda x=x, z=z: path.insert(0, x, z)):
            with pytest.raises(RequestError, match=r"allowed is up to 1000 m"):
                change()
        with pytest.raises(RequestError, match=r"point 2 of the path is at .* up to 1000 m"):
            path.move(1, x, z)
    with pytest.raises(RequestError, match="m long; allowed are 5000 m"):
        path.replace([(0.0, 1000.0 * (-1) ** k) for k in range(9)], closed=False)
    assert path.points == [(-1000.0, 1000.0), *SQUARE[1:]]
    assert path.curve is not None


@pytest.fixture
def page(show, monkeypatch):
    """The path's text in the page, once all that waits is done; the world does not move."""
    monkeypatch.setattr(show._view, "locate_ray", lambda ray: ray)

    def text() -> str:
        run(show, 3)
        return show._panel.path.text.content

    return text


DOWN = (0.0, -1.0, 0.0)


@pytest.mark.slow
def test_the_editor_does_what_is_dragged_and_pressed_and_says_what_cannot_be(show, page):
    editor = show.path
    assert "Drag a ball" in page()
    editor.remove()
    assert "no point is selected" in page()
    editor.insert()
    assert "between two" in page()
    show._panel.path.draw.value = True
    for x, z in SQUARE:
        show._draw_at((x, 2.0, z), DOWN)
    assert page() == "4 points, 6.3 m; point 4 is selected."
    places = editor._handles._points._handle.batched_positions
    np.testing.assert_allclose(places[:, ::2], SQUARE)
    show._draw_at((2.05, 2.0, 0.0), DOWN)
    assert page() == "4 points, 6.3 m; point 2 is selected.", "a click on a ball is none on the ground"
    editor._drag(1, "start", ((3.0, 2.0, -1.0), DOWN))
    editor._drag(1, "update", ((3.0, 2.0, -1.5), DOWN))
    editor._drag(1, "end", ((9.0, 2.0, 9.0), DOWN))
    assert "point 2 is selected" in page()
    assert editor.path.points[1] == (3.0, -1.5), "where a drag ends the mouse may be anywhere"
    editor.close(True)
    editor._drag_between(3, "start", ((-1.0, 2.0, 1.0), DOWN))
    editor._drag_between(3, "update", ((-1.2, 2.0, 1.0), DOWN))
    editor._drag_between(3, "end", ((-1.2, 2.0, 1.0), DOWN))
    assert page().startswith("5 points")
    assert show._panel.path.closed.value is True
    assert len(editor._handles._between._handle.batched_positions) == 5
    editor._click(0, False)
    editor._click(4, True)
    editor._click(99, False)
    assert page().startswith("4 points")
    editor.insert()
    assert page().startswith("5 points")
    editor.clear()
    assert "Drag a ball" in page()
    assert editor._handles._line is None


def test_a_closed_path_is_walked_on_and_on(show, actors, page):
    show.path.load("a.csv", b"0,0\n2,0\n2,2\n0,2\n0,0\n")
    assert page().startswith("4 points")
    show.walk_path()
    run(show, 1)
    assert actors[0].heard[-1] == ("walk", SQUARE, 1.2, True)


@pytest.mark.slow
def test_what_is_loaded_replaces_what_there_is_unless_it_is_none(show, page, monkeypatch, tmp_path):
    show.path.load("a.csv", b"0,0\n2,0\n2,2\n")
    page()
    for name, content in (("b.csv", b"1,1"), ("b.csv", b"0,0\n5000,0\n"), ("b.png", b""), ("b.svg", b"<svg")):
        show.path.load(name, content)
        assert "⚠️" in page()
        assert show.path.path.points == [(0.0, 0.0), (2.0, 0.0), (2.0, 2.0)]
    monkeypatch.chdir(tmp_path)
    show.path.keep()
    assert "The path is in mapctl-path.csv." in page()
    show.path.keep()
    assert "The path is in mapctl-path-2.csv." in page()
    assert curves.read(tmp_path / "mapctl-path-2.csv").length == pytest.approx(4.3, abs=0.3)
    show.path.keep(tmp_path / "none")
    assert "cannot be written" in page()
    show.path.clear()
    show.path.save(None)
    assert "2 points or more" in page()
