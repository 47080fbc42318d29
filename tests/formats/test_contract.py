"""Contract of every format: motions are read back as written, broken files are refused in a line or read as a
motion."""

import re
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
import torch
from acclaim import pair
from character_maker import make_character_glb
from direct_readers import read_directly
from helpers import make_smpl_parameters, random_motion, walk
from marker_files import MARKED, write_markers

from mapctl import curves, formats
from mapctl.errors import FileFormatError, MapctlError, RequestError
from mapctl.intent.keyframes import read_drawing, read_keys
from mapctl.intent.steering import read_commands
from mapctl.recording.masks import load_masks
from mapctl.retarget.rigs import read_rig_toml
from mapctl.skeleton import CANONICAL
from scenes import scene_file

ROOT = Path(__file__).resolve().parents[2]
PACKAGES = {"usd": "pxr", "fbx": "ufbx", "c3d": "ezc3d"}
INSTALLED = [e for e in formats.READERS if find_spec(PACKAGES.get(formats.READERS[e], "numpy"))]
WRITTEN = [e for e in INSTALLED if e in formats.WRITERS and e not in (".vrm", ".fbx")]  # whose tests need Blender
TABLES = {
    "steering.csv": (read_commands, "time_s,speed_mps,heading_deg,look_x,look_y,look_z\n0,1.2,0,,,\n2,1,9,1,1,1\n"),
    "curve.csv": (curves.read, "# drawn by hand\nz;y;x\n0,5;0;1\n1;0;2,5\n"),
    "curve.svg": (curves.read, '<svg><g transform="translate(10 20)"><path d="M0,0 Q50,50 100,0 T200,0"/></g></svg>'),
    "masks.csv": (load_masks, "joint,start,stop\nhips,0,10\n*,40,50\n"),
    "drawing.csv": (read_drawing, "joint,x,y\nhips,0,0\nhead,0,60\nleftHand,-30,10\nrightFoot,10,-80\n"),
    "rig.toml": (read_rig_toml, next((ROOT / "mapctl/retarget/presets").glob("*.toml")).read_text()),
    "scene.toml": (scene_file.load, next((ROOT / "scenes").glob("*.toml")).read_text()),
    "keys.toml": (read_keys, 'fps = 30\nbody = "a.bvh"\n[[key]]\nframe = 0\n[[key]]\nframe = 24\nplace = [0.1, 1.0]\n'),
}
"""Other files that a user gives: their readers, and small sound ones."""
WORDS = (b"nan", b"-1", b"1e999", b"9" * 400, b"", b"{", b'"', b"\xff", b"\0", b"x" * 3000, b"[" * 3000)


def make(folder: Path, ending: str) -> Path:
    """A small sound file."""
    path = folder / f"a{ending}"
    if ending == ".amc":
        return pair(3).write(folder)
    if ending in (".vrm", ".gltf", ".glb"):
        return make_character_glb(path, names="vrm", animations=("walk",), frames=5, second_skin=True).path
    if ending in (".pt", ".pth"):
        torch.save({"smpl_params_global": make_smpl_parameters(3)}, path)
    elif ending == ".fbx":
        from fbx_maker import make_fbx

        make_fbx(path, frames=3, parts=("shoes",))
    elif ending in MARKED:
        write_markers(path, walk(8, fps=60))
    elif ending == ".usdz":
        from pxr import UsdUtils

        UsdUtils.CreateNewUsdzPackage(str(make(folder, ".usdc")), str(path))
    elif ending.startswith(".usd"):
        from usd_maker import make_character_usd

        make_character_usd(path, frames=3, parts=("shoes",), up="Z", placed="animated")
    else:
        walk(4).save(path)
    return path


def mutate(raw: bytes, random: np.random.Generator) -> bytes:
    """Cut, change bytes, or put something else in place of a number or word."""
    kind, at = random.integers(4), int(random.integers(len(raw)))
    if kind == 0:
        return raw[:at]
    if kind == 1:
        return raw[:at] + bytes(random.integers(0, 256, 4, dtype=np.uint8)) + raw[at + 4 :]
    found = list(re.finditer(rb"-?\d[\d.e+-]*|\w+", raw[: 2**16]))
    if not found:
        return raw[at:]
    word = found[int(random.integers(len(found)))]
    return raw[: word.start()] + WORDS[int(random.integers(len(WORDS)))] + raw[word.end() :]


def assert_line(error: MapctlError, folder: Path) -> None:
    message = str(error).replace(str(folder), "")
    assert "\n" not in message
    assert len(message) < 600


@pytest.mark.parametrize("ending", WRITTEN)
def test_what_is_written_is_read_back(ending, tmp_path):
    motion, path = walk(12) if ending == ".vrma" else random_motion(CANONICAL, 12), tmp_path / f"a{ending}"
    motion.save(path)
    first = path.read_bytes()
    motion.save(path)
    assert path.read_bytes() == first
    with read_directly():
        again = formats.load(path)
    assert (sorted(again.skeleton.names), again.fps, again.num_frames) == (sorted(CANONICAL.names), 30, 12)
    order = [again.skeleton.index(name) for name in CANONICAL.names]  # files go down one limb after the other
    near = {".npz": 0.0, ".bvh": 1e-6}.get(ending, 1e-5)
    np.testing.assert_allclose(again.joint_positions()[:, order], motion.joint_positions(), rtol=0, atol=near)
    motion.root_position[3, 1] = torch.nan
    with pytest.raises(RequestError, match=r"finite|NaN|nan"):
        motion.save(path)
    assert path.read_bytes() == first


@pytest.mark.parametrize(
    "ending",  # the four of USD go through one reader, in a process of its own
    [pytest.param(e, marks=pytest.mark.slow) if e in (".usd", ".usdc", ".usda") else e for e in INSTALLED],
)
def test_sound_files_are_read_and_broken_ones_refused_in_a_line_or_read(ending, tmp_path):
    path = make(tmp_path, ending)
    motion = formats.load(path)
    assert motion.joint_positions().isfinite().all()
    if ending in formats.CHARACTERS:
        assert formats.load_rest(path).num_joints == motion.num_joints
        assert ending == ".vrma" or formats.load_mesh(path).joints.max() < motion.num_joints
    raw, random = path.read_bytes(), np.random.default_rng(1)
    for case in range({".usd": 2, ".fbx": 2, ".c3d": 4}.get(ending[:4], 8 if ending in MARKED else 40)):
        path.write_bytes(mutate(raw, random))
        for read in (formats.load, formats.load_mesh) if ending in formats.CHARACTERS else (formats.load,):
            try:
                found = read(path)
            except MapctlError as error:
                assert_line(error, tmp_path)
            else:
                numbers = found.joint_positions() if read is formats.load else torch.from_numpy(found.vertices)
                assert numbers.isfinite().all(), case


@pytest.mark.parametrize("name", TABLES)
def test_other_files_are_refused_in_a_line_or_read(name, tmp_path):
    read, text = TABLES[name]
    path, random = tmp_path / name, np.random.default_rng(2)
    walk(30).save(tmp_path / "a.bvh")
    path.write_text(text)
    read(path)
    for _ in range(40):
        path.write_bytes(mutate(text.encode(), random) or b" ")
        try:
            read(path)
        except MapctlError as error:
            assert_line(error, tmp_path)


@pytest.mark.parametrize("ending", INSTALLED)
def test_what_is_no_file_of_the_format_is_refused(ending, tmp_path):
    (tmp_path / f"folder{ending}").mkdir()
    (tmp_path / f"empty{ending}").touch()
    (tmp_path / f"hello{ending}").write_text("hello")
    for stem, words in {
        "gone": "no such",
        "folder": "is a folder",
        "empty": "is empty|needs the skeleton",
        "hello": r"\w",
    }.items():
        with pytest.raises(FileFormatError, match=words) as caught:
            formats.load(tmp_path / f"{stem}{ending}")
        assert_line(caught.value, tmp_path)
