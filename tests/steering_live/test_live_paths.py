"""Paths of the live viewer: points that are edited, files that are written and read, and what is no path."""

import numpy as np
import pytest
from stage import run

from mapctl import curves
from mapctl.errors import MapctlError, RequestError
from scenes.live import paths
from scenes.live.paths import MAX_POINTS, make_curve, read_path, sample_curve, write_csv

SQUARE = [(0.0, 0.0), (2.0, 0.0), (2.0, 2.0), (0.0, 2.0)]


@pytest.mark.parametrize("closed", [False, True])
def test_what_is_written_is_what_follow_reads_and_comes_back_in_few_points(closed, tmp_path):
    curve, table = make_curve(SQUARE, closed=closed), tmp_path / "path.csv"
    table.write_bytes(write_csv(curve))
    read = curves.read(table)
    assert (read.closed, read.length) == (closed, pytest.approx(curve.length, rel=1e-3))
    points, is_closed = read_path("path.csv", table.read_bytes())
    assert is_closed == closed
    assert len(points) < 25
    vertices = make_curve(points, closed=closed).points.numpy()
    apart = [np.linalg.norm(vertices - point, axis=1).min() for point in sample_curve(curve)]
    assert max(apart) < 0.05


def test_a_drawing_is_read():
    found, _ = read_path("d.svg", b'<svg><path d="M 0 0 C 100 0 200 100 200 200 L 200 400"/></svg>')
    assert found[0] == pytest.approx((0.0, 0.0), abs=1e-6)
    assert found[-1] == pytest.approx((2.0, 4.0), abs=1e-6)


@pytest.mark.parametrize(
    ("name", "content", "said"),
    [
        ("a.csv", b"1,2\n", "2 to 1000000 points, got 1"),
        ("a.csv", b"0,0\nnan,1\n", "a.csv, line 2: expected"),
        ("a.csv", b"0,0\n5000,0\n", "more than 1000 m from the origin"),
        ("a.svg", b"<svg", "cannot be read as an SVG"),
        ("walk.bvh", b"HIERARCHY", r"\.csv.*files, not from 'walk.bvh'"),
        ("../../x.csv/..", b"0,0\n1,1", "not from"),
        ("a.csv", b"0,0\n" * 3_000_000, "11 MiB; a path has at most 8"),
    ],
)
def test_files_that_are_no_paths_are_refused_in_a_line(name, content, said):
    with pytest.raises(MapctlError, match=said) as refused:
        read_path(name, content)
    assert "/tmp" not in str(refused.value)


@pytest.mark.parametrize(
    ("points", "said"),
    [
        ([(0.0, 0.0), (1000.1, 0.0)], "more than 1000 m from the origin"),
        ([(0.0, 0.0), (np.nan, 0.0)], "more than 1000 m from the origin"),
        ([(0.0, 1000.0 * (-1) ** k) for k in range(9)], "m long; allowed are 5000 m"),
        ([(0.01 * k, 0.0) for k in range(MAX_POINTS + 1)], "at most 200; it has 201"),
    ],
)
def test_what_is_no_path_is_refused(points, said):
    with pytest.raises(RequestError, match=said):
        make_curve(points, closed=False)


def test_the_editor_does_what_is_dragged_and_explains_what_is_impossible(show):
    editor, down = show.path, (0.0, -1.0, 0.0)
    run(show, 1)
    for point in (*SQUARE, (2.05, 0.0)):
        editor.add(point)
    assert show.panel.path.content == "4 points, 6.3 m.", "a click on a ball adds none"
    editor.drag(1, (show.view.chase.to_view(np.array([3.5, 2.0, -1.0])), down))
    assert editor.points[1] == pytest.approx((3.5, -1.0))
    editor.move(0, (np.nan, 0.0))
    assert "⚠️" in show.panel.path.content
    assert editor.points[0] == SQUARE[0]
    editor.edit(editor.points, closed=True)
    assert show.panel.closed.value is True
    editor.remove(2)
    editor.remove(99)
    assert len(editor.points) == 3
    editor.load("b.csv", b"1,1")
    assert "⚠️" in show.panel.path.content
    editor.load("a.csv", b"0,0\n2,0\n2,2\n")
    assert not editor.is_closed
    editor.edit([])
    assert show.panel.path.content == paths.HELP
    with pytest.raises(RequestError, match="2 points or more"):
        show.download_path(None)
