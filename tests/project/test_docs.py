"""The pages: every command is understood by the command line's parser, every Python block runs as it stands; so do the
```sh blocks of README.md and the tutorials, and the gallery, and what they ask for holds."""

import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import pages
import pytest
from followed_tutorials import follow

import mapctl
from mapctl.cli import parse
from mapctl.commands import COMMANDS

FOLLOWED = [page for page in pages.PAGES if page == "README.md" or "tutorials" in page]
GALLERY = [str(script.relative_to(pages.ROOT)) for script in sorted((pages.ROOT / "docs/gallery").glob("*.py"))]
PYTHON = [block for page in pages.PAGES if page not in FOLLOWED for block in pages.blocks(page, "python")]


def fill_in(line: str) -> str:
    """Add the required options that a command within a sentence leaves out."""
    line = line.replace("CURVE", "circle:4")
    lacking = {"train": ("--data DIR", "-o OUT"), "follow": ("-o OUT",)}.get(line.split()[1], ())
    return " ".join([line, *(option for option in lacking if option.split()[0] not in line)])


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """All files that the pages name."""
    folder = tmp_path_factory.mktemp("files")
    pages.write_files(folder)
    return folder


@pytest.mark.slow
@pytest.mark.parametrize("page", dict.fromkeys(block.page for block in PYTHON))
def test_python_runs_as_it_stands(page, files, tmp_path, monkeypatch):
    monkeypatch.setenv("MAPCTL_RENDERER", "stick")
    for block in [block for block in PYTHON if block.page == page]:
        shutil.copytree(files, tmp_path / str(block.number))
        monkeypatch.chdir(tmp_path / str(block.number))
        exec(compile(block.text, str(block), "exec"), {"__name__": "example"})


@pytest.mark.slow
@pytest.mark.timeout(1800)
@pytest.mark.parametrize("page", [*FOLLOWED, *GALLERY])
def test_steps_run_as_written_and_all_requests_hold(page, tmp_path, monkeypatch):
    monkeypatch.setenv("MAPCTL_RENDERER", "stick")
    if page == "README.md":
        pages.write_files(tmp_path)  # a tutorial begins in an empty folder
    follow(pages.ROOT / page, tmp_path)


@pytest.mark.slow
def test_the_script_that_is_checked_in_strict_mode_runs(tmp_path):
    script = Path(__file__).with_name("user_script.py")
    shown = subprocess.run(
        [sys.executable, script, "example:noisy-walk", tmp_path / "out"], capture_output=True, text=True, check=True
    ).stdout
    assert "hand height" in shown
    assert {mapctl.load(file).num_frames for file in tmp_path.glob("out-*.bvh")} == {240, 60}


def test_a_step_that_fails_or_does_not_hold_is_refused_unless_its_page_shows_that(tmp_path):
    page = tmp_path / "page.md"
    for step, status in (("sh\nfalse; true", 1), ("python\nprint('hand: 9 cm, NOT HELD')", 0)):
        page.write_text(f"```{step}\n```\n")
        with pytest.raises(RuntimeError, match=f"status {status}"):
            follow(page, tmp_path)
    page.write_text(f"{page.read_text()}```text\nhand: 8 cm, NOT HELD\n```\n")
    follow(page, tmp_path)


def test_commands_are_understood():
    shown = {line for page in pages.PAGES for line in pages.commands(page)}
    inline = {fill_in(line) for page in pages.PAGES for line in pages.inline_commands(page)}
    assert len(shown) > 40
    assert {line.split()[1] for line in shown} >= COMMANDS.keys() - {"demo"}
    for line in sorted(line for line in shown | inline if "--help" not in line):
        assert parse(shlex.split(line)[1:]) is not None


def test_links_of_the_pages_at_the_top_lead_to_files():
    for page in ("CHANGELOG.md", "CONTRIBUTING.md", "SECURITY.md"):
        links = re.findall(r"\]\(([^)#:]+)(?:#[^)]*)?\)", pages.read_page(page))
        assert [link for link in links if not (pages.ROOT / link).exists()] == []
