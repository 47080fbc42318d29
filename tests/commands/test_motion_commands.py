"""What `mapctl denoise`, `infill` and `tween` share as a user types them: bytes, films, formats, refusals."""

from importlib.util import find_spec

import pytest
from captures import on_rig
from helpers import run
from tiny_denoiser import save_tiny_denoiser
from tiny_infiller import save_tiny_infiller

WORDS = {"denoise": [], "infill": ["--gap", "5:9"], "tween": ["--keyframes", "0,5,11"]}
"""Without a network."""
NETWORK = {"denoise": "--denoiser", "infill": "--inbetweener", "tween": "--inbetweener"}
COMMANDS = sorted(WORDS)


@pytest.fixture(scope="module")
def tiny(tmp_path_factory):
    """The option and the network of each command."""
    folder = tmp_path_factory.mktemp("tiny")
    files = {
        "--denoiser": save_tiny_denoiser(folder / "denoiser.safetensors"),
        "--inbetweener": save_tiny_infiller(folder / "infiller.safetensors", drawn=0.02),
    }
    return {command: (option, files[option]) for command, option in NETWORK.items()}


@pytest.fixture
def source(tmp_path):
    """Twelve frames of a walk."""
    path = tmp_path / "in.bvh"
    on_rig("bandai", 12).save(path)
    return path


@pytest.mark.slow
@pytest.mark.parametrize("command", COMMANDS)
def test_the_same_bytes_come_twice_and_quiet_says_nothing(command, tiny, source, tmp_path, capsys):
    found = set()
    for _ in range(2):
        assert run(command, source, "-o", tmp_path / "out.bvh", *WORDS[command], *tiny[command], "--quiet") == 0
        found.add((tmp_path / "out.bvh").read_bytes())
    assert len(found) == 1
    assert capsys.readouterr().out == ""


@pytest.mark.slow
@pytest.mark.skipif(any(find_spec(name) is None for name in ("matplotlib", "PIL")), reason="needs mapctl[render]")
@pytest.mark.parametrize("command", COMMANDS)
def test_a_film_is_made(command, tiny, source, tmp_path):
    words = [*WORDS[command], *tiny[command], "--video", tmp_path / "v.png", "--quiet"]
    assert run(command, source, "-o", tmp_path / "out.bvh", *words) == 0
    assert (tmp_path / "v.png").read_bytes().startswith(b"\x89PNG")
