"""The pages: every command is understood by the command line's parser, every Python block runs as it stands.

Tutorials and the gallery are run where the site is built.
"""

import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import pages
import pytest

import mapctl
from mapctl.cli import parse
from mapctl.commands import COMMANDS

PYTHON = [block for page in pages.PAGES if "tutorials" not in page for block in pages.blocks(page, "python")]


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
        left: dict = {"__name__": "example"}
        exec(compile(block.text, str(block), "exec"), left)
        if str(block) == "README.md-python-0":
            assert left["solution"].ledger.summary()["path"]["residual_mean"] < 0.05
            assert mapctl.load("circle.bvh").num_frames == left["solution"].motion.num_frames


@pytest.mark.slow
def test_the_script_that_is_checked_in_strict_mode_runs(tmp_path):
    script = Path(__file__).with_name("user_script.py")
    shown = subprocess.run(
        [sys.executable, script, "example:noisy-walk", tmp_path / "out"], capture_output=True, text=True, check=True
    ).stdout
    assert "hand height" in shown
    assert {mapctl.load(file).num_frames for file in tmp_path.glob("out-*.bvh")} == {240, 60}


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
