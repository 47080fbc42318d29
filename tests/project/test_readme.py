"""The README's Python example runs as it stands, and the commands it shows exist."""

import re
import shlex
from pathlib import Path

import pytest

import mapctl
from mapctl.cli import parse

README = (Path(__file__).parents[2] / "README.md").read_text(encoding="utf-8")


TERMS = (Path(__file__).parents[2] / "docs" / "terms.md").read_text(encoding="utf-8")


def run(code: str, tmp_path, monkeypatch) -> dict:
    """What a block of a page leaves, run in an empty folder."""
    monkeypatch.chdir(tmp_path)
    left: dict = {"__name__": "example"}
    exec(compile(code, "example", "exec"), left)
    return left


def blocks(page: str) -> list[str]:
    return re.findall(r"```python\n(.*?)```", page, re.DOTALL)


def test_python_example_films_three_walkers(tmp_path, monkeypatch):
    code = blocks(README)[0]
    assert len([line for line in code.splitlines() if line.strip()]) <= 15
    run(code, tmp_path, monkeypatch)
    assert (tmp_path / "circles.mp4").stat().st_size > 1000


def test_python_example_weaves(tmp_path, monkeypatch):
    _, code = blocks(README)
    left = run(code, tmp_path, monkeypatch)
    assert left["state"].frames >= 60
    saved = mapctl.load(tmp_path / "weaving.bvh")
    assert saved.num_frames == left["recorder"].motion().num_frames >= 60


def test_a_term_of_ones_own_is_obeyed(tmp_path, monkeypatch):
    (code,) = blocks(TERMS)
    left = run(code, tmp_path, monkeypatch)
    assert left["held"] < 0.1
    hand = left["solution"].motion.skeleton.index("leftHand")
    assert left["solution"].motion.joint_positions()[30:, hand, 1].mean() == pytest.approx(1.3, abs=0.1)


def _commands() -> list[str]:
    blocks = re.findall(r"```\n(.*?)```", README, re.DOTALL)
    lines = [line.split("#")[0].strip() for block in blocks for line in block.splitlines()]
    return [line for line in lines if line.startswith("mapctl ")]


@pytest.mark.parametrize("line", _commands())
def test_commands_shown_are_understood(line):
    assert parse(shlex.split(line)[1:]) is not None


def test_the_readme_shows_every_command_once_at_least():
    shown = {line.split()[1] for line in _commands()}
    assert {"follow", "run", "generate", "measure", "convert", "render", "train", "bench", "info"} <= shown
