"""`mapctl bench all`: every table of the documentation by one command, and which figures moved."""

import json
from dataclasses import replace

import pytest
from helpers import run

from mapctl import cli
from mapctl.commands.bench.every import run as every
from mapctl.commands.bench.every.plan import list_tables, list_words
from mapctl.commands.bench.every.record import TableRecord, find_commit, list_moved
from mapctl.errors import FileFormatError

ROWS = [
    {"part": "walks", "curve": "circle:4", "method": "ours", "path_error_mean_cm": 1.6, "ms_per_frame": 8.0},
    {"part": "walks", "curve": "line:8", "method": "ours", "path_error_mean_cm": 1.4, "ms_per_frame": 8.0},
]


def make(rows=ROWS) -> TableRecord:
    return TableRecord.of("mapctl bench follow", "abc", 2.0, rows)


@pytest.fixture
def made(monkeypatch):
    """Instead of tables that take minutes, rows that a test may change; the words that were run."""
    asked, rows = [], [dict(row) for row in ROWS]

    def take(table, words):
        asked.append(words)
        return rows

    monkeypatch.setattr(every, "_make", take)
    monkeypatch.setattr(every, "find_commit", lambda folder: "abc")
    return asked, rows


@pytest.mark.parametrize("table", list_tables(""))
def test_the_command_of_every_table_is_understood(table):
    assert cli.parse(list_words(table)) is not None


def test_figures_that_move_beyond_their_noise_are_named():
    first, second = (dict(row) for row in ROWS)
    moved = [first | {"path_error_mean_cm": 1.7}, second | {"path_error_mean_cm": 1.41, "ms_per_frame": 9.0}]
    assert list(list_moved(make(), make(moved))) == ["walks, circle:4, ours: path_error_mean_cm 1.6 to 1.7"]


def test_rows_that_come_and_go_are_named():
    other = ROWS[0] | {"method": "theirs"}
    assert list(list_moved(make(), make([ROWS[0], other]))) == [
        "walks, circle:4, theirs: new",
        "walks, line:8, ours: gone",
    ]


def test_rows_of_the_same_texts_are_compared_in_order():
    twice = [{"curve": "circle:4", "error_cm": 1.0}, {"curve": "circle:4", "error_cm": 2.0}]
    changed = [twice[0], twice[1] | {"error_cm": 3.0}]
    assert list(list_moved(make(twice), make(changed))) == ["circle:4 #2: error_cm 2 to 3"]


def test_a_table_is_read_as_it_was_written(tmp_path):
    record = make()
    record.write(tmp_path / "follow.json")
    assert TableRecord.read(tmp_path / "follow.json") == record


def test_what_is_no_table_is_refused(tmp_path):
    (tmp_path / "follow.json").write_text("[1]")
    with pytest.raises(FileFormatError, match="not a table of mapctl bench all"):
        TableRecord.read(tmp_path / "follow.json")


def test_tables_are_made_once_and_again_where_the_commit_is_another(made, tmp_path, monkeypatch, capsys):
    (tmp_path / "data").mkdir()
    words = ["bench", "all", "--data", tmp_path / "data", "-o", tmp_path / "out", "--only", "follow,speed"]
    asked, rows = made
    assert run(*words) == 0
    assert asked[1] == ["bench", "follow", "--data", str(tmp_path / "data"), "--baselines", "free/locomotion"]
    assert json.loads((tmp_path / "out" / "follow.json").read_text())["command"].endswith(
        "--data DATA --baselines free/locomotion"
    )
    assert run(*words) == 0
    assert len(asked) == 2
    monkeypatch.setattr(every, "find_commit", lambda folder: "abd")
    rows[0]["path_error_mean_cm"] = 3.2
    capsys.readouterr()
    assert run(*words) == 0
    assert len(asked) == 4
    said = capsys.readouterr().out
    assert "follow: 1 figures moved" in said
    assert "walks, circle:4, ours: path_error_mean_cm 1.6 to 3.2" in said


def test_a_table_that_there_is_not_is_refused(fails, tmp_path):
    assert "there is no table 'flight'; there are speed, follow" in fails(
        "bench", "all", "--data", tmp_path, "-o", tmp_path / "out", "--only", "flight"
    )


@pytest.mark.slow
def test_a_table_that_fails_says_why(fails, tmp_path):
    said = fails("bench", "all", "--data", tmp_path, "-o", tmp_path / "out", "--only", "tween")
    assert "tween: " in said
    assert "does not hold the clips kept from training" in said


def test_the_commit_of_a_folder_without_one_is_the_version(tmp_path):
    from mapctl import __version__

    assert find_commit(tmp_path) == __version__
    assert replace(make(), commit=find_commit(tmp_path)).commit == __version__
