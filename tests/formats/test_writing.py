"""Whatever writes a file: it appears whole or not at all, with the permissions that files have, and a full disk is one
line.
"""

import os
import resource
import stat
from fractions import Fraction
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers import tiny_density, walk

from mapctl import formats, report
from mapctl.errors import WriteError
from mapctl.formats.atomic import atomic_path, write_bytes
from priors import checkpoints
from priors.checkpoints import write_tensors
from scenes.film import WRITERS, save_png

MOTION = walk(150)
PICTURE = np.random.default_rng(0).integers(0, 255, (240, 320, 3), dtype=np.uint8)
TENSORS = {"a": torch.zeros(200, 200)}


def _save(path):
    formats.save(MOTION, path)


def _film(writer, picture=PICTURE):
    def write(path):
        with atomic_path(path) as scratch, writer(scratch, picture.shape[1::-1], Fraction(30)) as add:
            for _ in range(4):
                add(picture)

    return write


def _card(path):
    density = tiny_density()
    checkpoints.save(density.reference.state_dict() | TENSORS, density.card, path)


WRITERS = {
    "a.bvh": _save,
    "a.npz": _save,
    "a.glb": _save,
    "a.mp4": _film(WRITERS[".mp4"]),
    "a.gif": _film(WRITERS[".gif"], PICTURE[::2, ::2]),  # colours of noise take long to choose
    "a.webp": _film(WRITERS[".webp"]),
    "a.png": lambda path: save_png(path, PICTURE),
    "a.json": lambda path: report.write_report({"values": list(range(9000))}, path),
    "a.safetensors": lambda path: write_tensors(path, TENSORS),
    "model.safetensors": _card,
} | ({"a.usda": _save, "a.usdc": _save} if find_spec("pxr") else {})


@pytest.fixture(params=WRITERS)
def name(request):
    return request.param


@pytest.fixture
def small_disk():
    """No file can grow beyond 20 kB, as far as this process goes; the kernel says so in the middle of a write."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, hard))
    yield
    resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


@pytest.fixture
def umask():
    """Sets it, and puts it back."""
    before = os.umask(0o022)
    yield os.umask
    os.umask(before)


def modes(folder: Path) -> set[int]:
    return {stat.S_IMODE(file.stat().st_mode) for file in folder.iterdir()}


def test_a_new_file_has_the_permissions_of_the_umask_and_one_written_over_keeps_its_own(tmp_path, name, umask):
    umask(0o027)
    WRITERS[name](tmp_path / name)
    assert modes(tmp_path) == {0o640}
    before = {file.name for file in tmp_path.iterdir()}
    for file in tmp_path.iterdir():
        file.chmod(0o444)
    WRITERS[name](tmp_path / name)
    assert {file.name for file in tmp_path.iterdir()} == before
    assert modes(tmp_path) == {0o444}


def test_what_nobody_else_may_read_is_not_shown_while_it_is_written(tmp_path, umask):
    write_bytes(tmp_path / "a", b"secret")
    (tmp_path / "a").chmod(0o600)
    with atomic_path(tmp_path / "a") as scratch:
        assert stat.S_IMODE(scratch.stat().st_mode) == 0o600


def test_a_full_disk_is_one_line_and_leaves_nothing(tmp_path, name, small_disk):
    with pytest.raises(WriteError, match=r"^cannot write .*: File too large$") as caught:
        WRITERS[name](tmp_path / name)
    assert name in str(caught.value)
    assert list(tmp_path.iterdir()) == []


def test_a_card_that_finds_no_room_takes_the_weights_with_it(tmp_path, monkeypatch):
    """Or there would be weights that nobody can load, or new ones under an old card."""
    density = tiny_density()
    monkeypatch.setattr(Path, "write_text", _no_space)
    with pytest.raises(WriteError, match=r"model\.json: No space left on device"):
        checkpoints.save(density.reference.state_dict(), density.card, tmp_path / "model.safetensors")
    assert list(tmp_path.iterdir()) == []


def _no_space(*words, **options):
    raise OSError(28, "No space left on device")
