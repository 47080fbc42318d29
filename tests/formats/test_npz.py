"""npz archives keep a motion exactly; whatever writes a file, it appears whole or not at all."""

import io
import os
import resource
import stat
from fractions import Fraction
from importlib.util import find_spec
from pathlib import Path

import hypothesis.strategies as st
import numpy as np
import pytest
import torch
from helpers import tiny_density, walk
from hypothesis import given, settings

from mapctl import formats, report
from mapctl.errors import FileFormatError, RequestError, WriteError
from mapctl.formats import npz
from mapctl.formats.atomic import atomic_path, check_writable, write_bytes, write_text
from mapctl.motion import Motion
from mapctl.skeleton import CANONICAL
from priors import checkpoints
from priors.checkpoints import write_tensors
from scenes.film import WRITERS, save_png


def example(frames=5, fps=Fraction(24000, 1001), seed=0) -> Motion:
    generator = torch.Generator().manual_seed(seed)
    root, quat, track = (
        torch.randn(frames, *shape, generator=generator, dtype=torch.float64) for shape in ((3,), (21, 4), (3,))
    )
    return Motion(CANONICAL, fps, root, torch.nn.functional.normalize(quat, dim=-1), {4: track})


def archive(motion: Motion, **changes) -> bytes:
    """The archive of a motion with some keys changed, or left out where the change is None."""
    arrays = {**npz.to_arrays(motion), **changes}
    buffer = io.BytesIO()
    np.savez(buffer, **{key: values for key, values in arrays.items() if values is not None})
    return buffer.getvalue()


@settings(max_examples=20, deadline=None, derandomize=True)
@given(st.integers(1, 9), st.fractions(Fraction(1, 10), 1000, max_denominator=10**6), st.integers(0, 99))
def test_a_motion_comes_back_exactly(tmp_path_factory, frames, fps, seed):
    motion, path = example(frames, fps, seed), tmp_path_factory.mktemp("npz") / "walk.npz"
    motion.save(path)
    read = formats.load(path)
    assert read.fps == fps
    assert (read.skeleton.names, read.skeleton.parents) == (CANONICAL.names, CANONICAL.parents)
    assert read.skeleton.end_offsets == CANONICAL.end_offsets
    assert torch.equal(read.skeleton.offsets, CANONICAL.offsets)
    assert torch.equal(read.root_position, motion.root_position)
    assert torch.equal(read.local_quat_xyzw, motion.local_quat_xyzw)
    assert torch.equal(read.moving_offsets[4], motion.moving_offsets[4])
    first = path.read_bytes()
    read.save(path)
    assert path.read_bytes() == first


QUAT = npz.to_arrays(example())["local_quat_xyzw"]
CHANGES = {
    "missing": ({"parents": None, "fps": None}, "lacks the keys parents, fps"),
    "other version": ({"format": np.array("mapctl-motion-9")}, "format is 'mapctl-motion-9'"),
    "fewer joints": ({"local_quat_xyzw": QUAT[:, :20]}, r"local_quat_xyzw .* expected .*\(5, 21, 4\)"),
    "no rotation": ({"local_quat_xyzw": QUAT * 0}, "no unit quaternion"),
    "no frames": (
        {
            "root_position_world": np.zeros((0, 3)),
            "local_quat_xyzw": np.zeros((0, 21, 4)),
            "moving_offsets": np.zeros((1, 0, 3)),
        },
        "at least one frame",
    ),
    "no rate": ({"fps": np.array([30, 0])}, "does not hold a motion"),
    "not a tree": ({"parents": np.full(21, 3)}, "joint 0 must be the root"),
    "same names": (
        {"names": np.array([*CANONICAL.names[:20], "hips"]), "end_names": np.array(["hips"] * 5)},
        "a joint once",
    ),
    "stray end": ({"end_names": np.array(["a", "b", "c", "d", "e"])}, "joints of the skeleton"),
    "objects": ({"names": np.array([object()] * 21)}, "not a sound .npz archive"),
}


@pytest.mark.parametrize("case", CHANGES)
def test_an_archive_that_is_no_motion_is_refused(case, tmp_path):
    changes, words = CHANGES[case]
    (tmp_path / "walk.npz").write_bytes(archive(example(), **changes))
    with pytest.raises(FileFormatError, match=words) as caught:
        formats.load(tmp_path / "walk.npz")
    assert "\n" not in str(caught.value)


def test_pickled_objects_are_never_run(tmp_path):
    class Trap:
        def __reduce__(self):
            return os.mkdir, (str(tmp_path / "sprung"),)

    (tmp_path / "walk.npz").write_bytes(archive(example(), format=np.array(Trap(), dtype=object)))
    with pytest.raises(FileFormatError, match="not a sound"):
        formats.load(tmp_path / "walk.npz")
    assert not (tmp_path / "sprung").exists()


def test_an_archive_that_unpacks_too_large_is_refused_before_it_is(tmp_path, monkeypatch):
    monkeypatch.setattr(npz, "MAX_FILE_BYTES", 1000)
    example().save(tmp_path / "walk.npz")
    with pytest.raises(FileFormatError, match="unpacks to"):
        formats.load(tmp_path / "walk.npz")


def test_an_interrupted_output_leaves_the_old_file_and_nothing_else(tmp_path):
    path = tmp_path / "report.json"
    write_text(path, "old")

    def stop():
        with atomic_path(path) as scratch:
            assert scratch.suffix == ".json"
            scratch.write_text("half")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        stop()
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_places_that_cannot_be_written_are_named(tmp_path):
    (tmp_path / "file").write_text("x")
    (tmp_path / "folder.bvh").mkdir()
    positions = {
        "missing/out.bvh": "does not exist",
        "file/out.bvh": "does not exist",
        "folder.bvh": "is a folder",
        "x" * 300 + ".bvh": "cannot write",
    }
    for position, words in positions.items():
        for attempt in (check_writable, lambda path: write_text(path, "x"), example().save):
            with pytest.raises(RequestError, match=words):
                attempt(tmp_path / position)
    with pytest.raises(RequestError, match="not a regular file"):
        write_text(os.devnull, "x")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["file", "folder.bvh"]


def test_a_link_is_followed_and_kept(tmp_path):
    (tmp_path / "real.txt").write_text("old")
    (tmp_path / "link.txt").symlink_to("real.txt")
    write_text(tmp_path / "link.txt", "new")
    assert (tmp_path / "link.txt").is_symlink()
    assert (tmp_path / "real.txt").read_text() == "new"


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
