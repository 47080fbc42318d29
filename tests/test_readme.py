"""The README's Python example runs as it stands, and the commands it shows exist."""

import re
import shlex
from pathlib import Path

import pytest

from mapctl.cli import parse

README = (Path(__file__).parent.parent / "README.md").read_text(encoding="utf-8")


def test_python_example_films_three_walkers(tmp_path, monkeypatch):
    block = re.search(r"```python\n(.*?)```", README, re.DOTALL)
    assert block is not None
    code = block.group(1)
    assert len([line for line in code.splitlines() if line.strip()]) <= 15
    monkeypatch.chdir(tmp_path)
    exec(compile(code, "README.md", "exec"), {})
    assert (tmp_path / "circles.mp4").stat().st_size > 1000


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
