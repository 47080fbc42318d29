"""Tutorials: the build of the site follows them step by step; here, that it would notice a step that fails, and a
picture that no step makes."""

import re

import pages
import pytest

followed_tutorials = pages.import_extension("followed_tutorials")

TUTORIALS = sorted((pages.ROOT / "docs" / "tutorials").glob("*.md"))


@pytest.fixture
def page(tmp_path):
    """A tutorial of two steps, the second of which reads what the first one wrote."""
    path = tmp_path / "page.md"
    path.write_text(
        "# A page\n\n```sh\necho 12 > number.txt\n```\n\n```python\nassert int(open('number.txt').read()) == 12\n```\n"
    )
    return path


@pytest.mark.parametrize("tutorial", TUTORIALS, ids=lambda path: path.stem)
def test_every_picture_is_one_that_a_step_makes(tutorial):
    text = tutorial.read_text("utf-8")
    shown = re.findall(rf"made/{tutorial.stem}/([\w.-]+)", text)
    steps = "\n".join(step.text for step in followed_tutorials.read_steps(tutorial))
    assert shown
    assert [name for name in shown if name not in steps] == []
    assert f"made/{tutorial.stem}/" in text
    assert "made/" not in text.replace(f"made/{tutorial.stem}/", "")


def test_there_is_one_for_each_kind_of_reader():
    assert {path.stem for path in TUTORIALS} == {"animator", "game-engineer", "capture-artist", "researcher"}


def test_steps_are_done_in_order_in_one_folder(page, tmp_path):
    folder = tmp_path / "work"
    folder.mkdir()
    followed_tutorials.follow(page, folder)
    assert (folder / "number.txt").read_text() == "12\n"


@pytest.mark.parametrize("broken", ["```sh\nls nothing-of-that-name\n```\n", "```python\nraise SystemExit(3)\n```\n"])
def test_a_step_that_fails_is_named(page, tmp_path, broken):
    page.write_text(page.read_text() + broken)
    with pytest.raises(followed_tutorials.ExtensionError, match=r"page\.md, step 3, ended with"):
        followed_tutorials.follow(page, tmp_path)


def test_a_line_that_fails_ends_its_step(page, tmp_path):
    page.write_text("```sh\nfalse\necho later > later.txt\n```\n")
    with pytest.raises(followed_tutorials.ExtensionError):
        followed_tutorials.follow(page, tmp_path)
    assert not (tmp_path / "later.txt").exists()
