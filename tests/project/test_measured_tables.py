"""Tables of the pages: they show what `mapctl bench all` measured, as it was measured."""

import json

import pages
import pytest

measured_tables = pages.import_extension("measured_tables")

DOCS = pages.ROOT / "docs"
RECORD = {
    "command": "mapctl bench follow --data DATA",
    "date": "2026-11-26",
    "commit": "0123456789ab",
    "machine": "a machine, 2 cores, Linux",
    "minutes": 3.2,
    "rows": [
        {"part": "walks", "curve": "line:8", "error_m": 0.01234, "worst_m": 0.05, "apart": 0.694, "clips": 12},
        {"part": "walks", "curve": "circle:4", "error_m": 1234.5, "worst_m": None, "apart": 1, "clips": 3},
        {"part": "runs", "curve": "line:8", "error_m": 0.5, "worst_m": float("nan"), "apart": 0.5, "clips": 1},
    ],
}


@pytest.fixture
def tables(tmp_path):
    """A folder with a record."""
    (tmp_path / "follow.json").write_text(json.dumps(RECORD))
    return tmp_path


def region(*spec, body=""):
    return "\n".join(
        ["Before.", "", "<!-- table: follow", *spec, f"-->{body}", "<!-- end of table -->", "", "After.\n"]
    )


def show(tables, *spec):
    """The lines of the table that a page then shows."""
    text = measured_tables.fill(region(*spec), tables)
    assert text.startswith("Before.\n\n<!-- table: follow\n")
    assert text.endswith("<!-- end of table -->\n\nAfter.\n")
    return text.split("-->\n")[1].removesuffix("<!-- end of table ").strip().splitlines()


def test_columns_come_in_the_order_and_under_the_headings_of_the_page(tables):
    rows = show(tables, "clips: n", "curve: along", "@part: walks", "@sources: no")
    assert rows == ["| n | along |", "|---|---|", "| 12 | line:8 |", "| 3 | circle:4 |"]


def test_numbers_are_written_as_the_page_says(tables):
    rows = show(
        tables,
        "error_m: m",
        "error_m / worst_m: mean / max, m | .1",
        "apart to apart: told apart | %",
        "@where curve: line:.*",
        "@part: walks|runs",
        "@sources: no",
    )
    assert rows[2:] == ["| 0.0123 | 0.0 / 0.1 | 69 % to 69 % |", "| 0.5 | 0.5 | 50 % to 50 % |"]


def test_three_digits_without_a_style(tables):
    assert show(tables, "error_m: m", "@where curve: circle:4", "@sources: no")[2:] == ["| 1234 |"]


def test_the_line_below_says_where_figures_are_from(tables):
    last = show(tables, "curve: along")[-1]
    assert last == "*`mapctl bench follow --data DATA`, 2026-11-26, commit 0123456789ab, a machine, 2 cores, Linux.*"


def test_what_stood_there_is_replaced_and_filling_again_changes_nothing(tables):
    once = measured_tables.fill(region("curve: along", body="\n| 99 | by hand |"), tables)
    assert "by hand" not in once
    assert measured_tables.fill(once, tables) == once


@pytest.mark.parametrize(
    ("spec", "said"),
    [
        (["speed: m/s"], "no column 'speed'; it has part, curve"),
        (["curve: along", "@part: swims"], "no row of follow.json fits"),
        (["curve"], "a line of a table is 'column: heading', got 'curve'"),
        (["error_m: m | round"], "not written as 'round'"),
    ],
)
def test_what_a_record_lacks_is_named(tables, spec, said):
    with pytest.raises(ValueError, match=said):
        measured_tables.fill(region(*spec), tables)


def test_a_record_that_is_missing_is_named(tmp_path):
    with pytest.raises(ValueError, match=r"no record follow\.json; mapctl bench all makes it"):
        measured_tables.fill(region("curve: along"), tmp_path)


def test_a_table_without_an_end_is_no_table(tables):
    text = region("curve: along").replace("<!-- end of table -->", "")
    with pytest.raises(ValueError, match="a table has no end"):
        measured_tables.fill(text, tables)


def test_the_build_ends_where_a_page_is_not_up_to_date(tables, tmp_path):
    docs = tmp_path / "docs"
    docs.mkdir()
    (docs / "tables").symlink_to(tables)
    page = docs / "page.md"
    app = type("App", (), {"srcdir": docs})
    page.write_text(measured_tables.fill(region("curve: along"), tables))
    measured_tables.check_all(app)
    page.write_text(page.read_text().replace("line:8", "line:9"))
    with pytest.raises(measured_tables.ExtensionError, match=r"page\.md does not show what was measured"):
        measured_tables.check_all(app)


def test_pages_in_folders_are_found():
    shown = {page.name for page in measured_tables.list_pages(DOCS)}
    assert {"results.md", "infilling.md", "weights.md"} <= shown


@pytest.mark.parametrize("page", list(measured_tables.list_pages(DOCS)), ids=lambda page: page.stem)
def test_pages_show_what_was_measured(page):
    text = page.read_text("utf-8")
    assert measured_tables.fill(text, DOCS / "tables") == text
