"""The pages run: every Python block as it stands, every command on small models, in a folder with the files they name.

What needs a data set, a browser, ray or another machine is read by the command line's own parser, as every command is.
"""

import re
import shlex
import shutil

import pages
import pytest
from helpers import run

import mapctl
from mapctl.cli import parse
from mapctl.commands import COMMANDS

ALL = [(page, line) for page in pages.PAGES for line in pages.commands(page)]
INLINE = [line for page in pages.PAGES for line in pages.inline_commands(page)]
NOT_RUN = re.compile(r"mapctl (live|bench|demo|train all)\b|DATA|--cluster")
LONG = re.compile(
    r"mapctl (run|chain|train (refiner|.* (mocap|everything)/)|tween (docs|.*(120|LeftHand)$))"
    "|--(causal|best-of|variations|reference|jobs|root-only|suggest-timing|init|video|loop)|auto|denoise example:"
    "|7s:8.5s|reaching.csv|arriving.csv|--start take.bvh|--(joints leftHand|curve) .*stitcher|--method rollouts|.webp"
    "|denoise take(.*--plot|s)|generate -o many|--(joints LeftForeArm|way (0|60|20):|dna wave.bvh --method)"
    "|--mirror --root-motion|curves.png|keyframes 20,50"
)
# Tutorials are followed step by step where the site is built (docs/extensions/followed_tutorials.py).
PYTHON = [block for page in pages.PAGES if "tutorials" not in page for block in pages.blocks(page, "python")]
LONG_PYTHON = {
    "README.md-python-0",
    "docs/explanations/realism.md-python-0",
    "docs/guides/keyframes.md-python-1",
    "docs/guides/folders.md-python-0",
    "docs/reference/api/jobs.md-python-4",
    "docs/reference/api/solver.md-python-0",
    "docs/reference/api/steering.md-python-2",
    "docs/guides/keyframes.md-python-0",
    "docs/explanations/denoising.md-python-0",
    "docs/guides/keyframes.md-python-2",
    "docs/guides/keyframes.md-python-3",
    "docs/guides/live-from-python.md-python-0",
    "docs/guides/adding-a-term.md-python-0",
    "docs/guides/adding-a-job.md-python-0",
    "docs/reference/api/jobs.md-python-0",
    "docs/reference/api/jobs.md-python-2",
    "docs/reference/api/measures.md-python-2",
    "docs/reference/api/scenes.md-python-0",
    "docs/reference/api/steering.md-python-1",
}


def fill_in(line: str) -> str:
    """Inline commands leave out what the sentence is not about, or say it in capitals."""
    line = line.replace("CURVE", "circle:4")
    lacking = {"train": ("--data DIR", "-o OUT"), "follow": ("-o OUT",)}.get(line.split()[1], ())
    return " ".join([line, *(option for option in lacking if option.split()[0] not in line)])


def marked(cases, *, long) -> list:
    """Those that take long marked so."""
    return [pytest.param(case, marks=pytest.mark.slow if long(case) else (), id=str(case)) for case in cases]


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """All files that the pages name."""
    folder = tmp_path_factory.mktemp("files")
    pages.write_files(folder)
    return folder


@pytest.fixture
def folder(files, tmp_path, monkeypatch):
    """A copy of them, and the current folder."""
    shutil.copytree(files, tmp_path, dirs_exist_ok=True)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MAPCTL_RENDERER", "stick")
    return tmp_path


def assert_it_follows(folder, left):
    assert left["solution"].ledger.summary()["path"]["residual_mean"] < 0.05
    assert mapctl.load(folder / "circle.bvh").num_frames == left["solution"].motion.num_frames


def assert_hand_is_raised(folder, left):
    assert left["missed"] < 0.05
    hand = left["walk"].motion.skeleton.index("leftHand")
    for job in ("walk", "tweened"):
        assert "hand height" in left[job].ledger.summary()
    heights = left["walk"].motion.joint_positions()[:, hand, 1]
    assert float(heights[60]) == pytest.approx(1.3, abs=0.05)


def assert_it_arrives(folder, left):
    assert left["walked"].motion.root_position[-1, ::2].tolist() == pytest.approx([1.0, 3.0], abs=0.15)
    assert (folder / "there.bvh").exists()


def assert_it_is_named(folder, left):
    assert ": ease in and out" in left["eased"].gap_notes[0]


def assert_turned(folder, left):
    before, after = mapctl.load(folder / "walk.npz"), mapctl.load(folder / "turned.npz")
    mirrored = before.joint_positions() * before.root_position.new_tensor([-1.0, 1.0, -1.0])
    assert (after.joint_positions() - mirrored).abs().max() < 1e-6


def assert_keys_and_gaps_are_filled(folder, left):
    assert mapctl.load(folder / "whole.bvh").num_frames == left["clip"].num_frames


def assert_cleaned(folder, left):
    assert (folder / "clean.bvh").exists()


OUTCOMES = {
    "README.md-python-0": assert_it_follows,
    "docs/guides/adding-a-term.md-python-0": assert_hand_is_raised,
    "docs/guides/adding-a-prior.md-python-1": assert_it_is_named,
    "docs/guides/adding-a-job.md-python-0": assert_it_arrives,
    "docs/guides/formats.md-python-0": assert_turned,
    "docs/guides/keyframes.md-python-0": assert_keys_and_gaps_are_filled,
    "docs/explanations/denoising.md-python-0": assert_cleaned,
}
"""What else holds of a block that ran, by its name: of the folder and of what it left."""


@pytest.mark.parametrize("block", marked(PYTHON, long=lambda block: str(block) in LONG_PYTHON))
def test_python_runs_as_it_stands(block, folder):
    left: dict = {"__name__": "example"}
    exec(compile(block.text, str(block), "exec"), left)
    OUTCOMES.get(str(block), lambda folder, left: None)(folder, left)


def test_the_first_example_is_short():
    code = pages.blocks("README.md", "python")[0].text
    assert len([line for line in code.splitlines() if line.strip()]) <= 15


@pytest.mark.parametrize("line", sorted({line for _, line in ALL} | set(map(fill_in, INLINE))))
def test_commands_are_understood(line):
    assert parse(shlex.split(line)[1:]) is not None


RUN = sorted({line for _, line in ALL if not NOT_RUN.search(line)})


@pytest.mark.parametrize("line", marked(RUN, long=LONG.search))
def test_commands_run(line, folder, capsys):
    before = {path: path.stat().st_mtime_ns for path in folder.rglob("*") if path.is_file()}
    assert run(*pages.shorten(line)) in (0, 3), capsys.readouterr().err
    after = {path: path.stat().st_mtime_ns for path in folder.rglob("*") if path.is_file()}
    assert after != before or line.split()[1] in ("compile", "info", "measure"), "it writes something"


def test_the_pages_show_every_command():
    assert COMMANDS.keys() - {line.split()[1] for _, line in ALL} <= {"demo"}


def test_blocks_of_every_kind_are_found():
    assert len(PYTHON) >= 6
    assert len(RUN) > 40
