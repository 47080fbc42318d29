"""The built wheel is whole: installed alone in a clean environment, it imports, runs and holds its data."""

import json
import os
import re
import shutil
import subprocess
import sys
import sysconfig
import zipfile
from pathlib import Path

import pages
import pytest

from mapctl import __version__
from priors.licences import FREE

ROOT = Path(__file__).resolve().parents[2]
PACKAGES = ("mapctl", "priors", "controllers", "scenes")
DATA = (
    "mapctl/blender/addon/*.toml",
    "mapctl/examples/*",
    "mapctl/joint_ranges/*.json",
    "mapctl/retarget/presets/*.toml",
    "priors/weights/*",
    "priors/weights/free/*",
    "scenes/*.toml",
    "scenes/data/*",
)
LOCAL = shutil.ignore_patterns("__pycache__", ".*")
# No path of the checkout may leak into the clean environment.
ENVIRONMENT = {name: value for name, value in os.environ.items() if not name.startswith(("PYTHON", "VIRTUAL_ENV"))}


def run(*command: str | Path, cwd: Path) -> str:
    done = subprocess.run(
        command, cwd=cwd, env=ENVIRONMENT, capture_output=True, text=True, timeout=240, stdin=subprocess.DEVNULL
    )
    assert done.returncode == 0, done.stderr[-2000:]
    return done.stdout.strip()


@pytest.fixture(scope="module")
def wheel(tmp_path_factory) -> Path:
    """Built from a copy, so that the checkout stays clean and no stale build folder gets in."""
    work = tmp_path_factory.mktemp("build")
    source = work / "source"
    source.mkdir()
    for package in PACKAGES:
        shutil.copytree(ROOT / package, source / package, ignore=LOCAL)
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, source)
    pip = (sys.executable, "-m", "pip", "--disable-pip-version-check")
    run(*pip, "wheel", "-q", "--no-deps", "--no-index", "--no-build-isolation", "-w", work, source, cwd=work)
    (built,) = work.glob("mapctl-*.whl")
    return built


@pytest.fixture(scope="module")
def clean(wheel, tmp_path_factory) -> Path:
    """The bin folder of a fresh environment: the wheel, and the dependencies this one already has."""
    work = tmp_path_factory.mktemp("clean")
    run(sys.executable, "-m", "venv", "--without-pip", work / "venv", cwd=work)
    scripts = work / "venv" / "bin"
    pip = (sys.executable, "-m", "pip", "--disable-pip-version-check", "--python", scripts / "python")
    run(*pip, "install", "-q", "--no-deps", "--no-index", wheel, cwd=work)
    # Afterwards, so that pip does not meet the checkout's own installation; its .pth files are not followed.
    (site,) = (work / "venv" / "lib").glob("python*/site-packages")
    (site / "parent.pth").write_text(sysconfig.get_path("purelib") + "\n")
    return scripts


@pytest.fixture(scope="module")
def held(wheel) -> set[str]:
    with zipfile.ZipFile(wheel) as archive:
        return set(archive.namelist())


def read(wheel: Path, name: str) -> str:
    with zipfile.ZipFile(wheel) as archive:
        return archive.read(name).decode()


@pytest.mark.slow
def test_command_runs_elsewhere(clean, tmp_path):
    assert __version__ in run(clean / "mapctl", "--version", cwd=tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_packages_import_from_the_wheel(clean, tmp_path):
    script = f"import {', '.join(PACKAGES)}; print(*(p.__file__ for p in ({', '.join(PACKAGES)})), sep='\\n')"
    files = run(clean / "python", "-c", script, cwd=tmp_path).splitlines()
    assert [Path(file).is_relative_to(clean.parent) for file in files] == [True] * len(PACKAGES)


def test_every_source_and_data_file_is_held(held):
    wanted = [file for package in PACKAGES for file in (ROOT / package).rglob("*.py")]
    wanted += [file for pattern in DATA for file in ROOT.glob(pattern)]
    names = {file.relative_to(ROOT).as_posix() for file in wanted if file.is_file() and not file.name.startswith(".")}
    assert names - held == set()


def test_data_is_held(held):
    assert {"mapctl/retarget/presets/bandai_namco.toml", "mapctl/retarget/presets/cmu_daz.toml"} <= held
    weights = {Path(name).suffix for name in held if name.startswith("priors/weights/")}
    assert {".safetensors", ".json"} <= weights
    assert any(name.startswith("scenes/") and name.endswith(".toml") for name in held)


@pytest.mark.slow
def test_its_example_is_found_elsewhere(clean, tmp_path):
    run(clean / "mapctl", "convert", "example:noisy-walk", "walk.npz", cwd=tmp_path)
    assert (tmp_path / "walk.npz").is_file()


@pytest.mark.slow
@pytest.mark.timeout(1200)
@pytest.mark.parametrize("name", ["animator", "capture-artist", "game-engineer", "researcher"])
def test_tutorials_can_be_followed_elsewhere(clean, tmp_path, name):
    tutorials = pages.import_extension("followed_tutorials")
    page = ROOT / "docs" / "tutorials" / f"{name}.md"
    tutorials.follow(page, tmp_path, str(clean / "python"), ENVIRONMENT)
    made = {path.name for path in tmp_path.rglob("*") if path.suffix in tutorials.PICTURES}
    shown = set(re.findall(rf"made/{name}/([\w.-]+)", page.read_text("utf-8")))
    assert shown <= made


def test_licences_of_code_and_weights_are_told(wheel, held):
    folder = f"mapctl-{__version__}.dist-info"
    told = read(wheel, f"{folder}/METADATA")
    assert "\nLicense-Expression: MIT AND CC-BY-NC-4.0 AND LicenseRef-Free-For-Any-Use\n" in told
    files = {name.removeprefix(f"{folder}/licenses/") for name in held if name.startswith(f"{folder}/licenses/")}
    assert files == {"LICENSE", "priors/weights/LICENSE.md", "mapctl/examples/LICENSE.md"}
    notice = read(wheel, f"{folder}/licenses/priors/weights/LICENSE.md")
    for word in (
        "CC-BY-NC-4.0",
        "LicenseRef-Free-For-Any-Use",
        "Bandai Namco Research",
        "arXiv 2306.08861",
        "mocap.cs.cmu",
    ):
        assert word in notice


def test_every_card_has_the_licence_of_its_set(wheel, held):
    cards = [name for name in held if name.startswith("priors/weights/") and name.endswith(".json")]
    assert {name.removesuffix(".json") + ".safetensors" for name in cards} <= held
    by_set: dict[str, set[str]] = {}
    for name in cards:
        by_set.setdefault(str(Path(name).parent), set()).add(json.loads(read(wheel, name))["licence"])
    assert by_set.pop("priors/weights") == {"CC BY-NC 4.0"}
    assert by_set.pop("priors/weights/free") <= set(FREE)
    assert by_set == {}


def test_it_is_small(wheel):
    assert wheel.stat().st_size < 100e6


def test_nothing_else_is_held(held):
    tops = {name.split("/")[0] for name in held}
    assert {top for top in tops if not top.endswith(".dist-info")} == set(PACKAGES)
