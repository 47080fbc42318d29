"""The wheel: installed alone in a clean environment it runs, and it holds its data and licences."""

import json
import os
import shutil
import subprocess
import sys
import sysconfig
import zipfile
from pathlib import Path

import pytest

from mapctl import __version__

pytestmark = pytest.mark.slow

ROOT = Path(__file__).resolve().parents[2]
PACKAGES = ("mapctl", "priors", "controllers", "scenes")
DATA = (
    "*/py.typed",
    "mapctl/blender/addon/*.toml",
    "mapctl/examples/*",
    "mapctl/joint_ranges/*.json",
    "mapctl/retarget/presets/*.toml",
    "priors/weights/*",
    "priors/weights/free/*",
    "scenes/*.toml",
    "scenes/data/*",
)
# No path of the checkout may leak into the clean environment.
ENVIRONMENT = {name: value for name, value in os.environ.items() if not name.startswith(("PYTHON", "VIRTUAL_ENV"))}
PIP = (sys.executable, "-m", "pip", "--disable-pip-version-check")


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
    for package in PACKAGES:
        shutil.copytree(ROOT / package, work / "source" / package, ignore=shutil.ignore_patterns("__pycache__", ".*"))
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, work / "source")
    run(*PIP, "wheel", "-q", "--no-deps", "--no-index", "--no-build-isolation", "-w", work, work / "source", cwd=work)
    (built,) = work.glob("mapctl-*.whl")
    return built


def test_it_runs_in_a_clean_environment(wheel, tmp_path):
    run(sys.executable, "-m", "venv", "--without-pip", tmp_path / "venv", cwd=tmp_path)
    scripts = tmp_path / "venv" / "bin"
    run(*PIP, "--python", scripts / "python", "install", "-q", "--no-deps", "--no-index", wheel, cwd=tmp_path)
    # Afterwards, so that pip does not meet the checkout's own installation; its .pth files are not followed.
    (site,) = (tmp_path / "venv" / "lib").glob("python*/site-packages")
    (site / "parent.pth").write_text(sysconfig.get_path("purelib") + "\n")
    script = f"import {', '.join(PACKAGES)}; print(*(p.__file__ for p in ({', '.join(PACKAGES)})), sep='\\n')"
    files = run(scripts / "python", "-c", script, cwd=tmp_path).splitlines()
    assert all(Path(file).is_relative_to(scripts.parent) for file in files)
    assert __version__ in run(scripts / "mapctl", "--version", cwd=tmp_path)
    run(scripts / "mapctl", "convert", "example:noisy-walk", "walk.npz", cwd=tmp_path)
    assert (tmp_path / "walk.npz").is_file()


def test_it_holds_sources_data_and_licences_and_nothing_else(wheel):
    with zipfile.ZipFile(wheel) as archive:
        held = {*archive.namelist()}
        cards = [name for name in held if name.startswith("priors/weights/") and name.endswith(".json")]
        licences = {(str(Path(card).parent), json.loads(archive.read(card))["licence"]) for card in cards}
    wanted = [file for package in PACKAGES for file in (ROOT / package).rglob("*.py")]
    wanted += [file for pattern in DATA for file in ROOT.glob(pattern)]
    names = {file.relative_to(ROOT).as_posix() for file in wanted if file.is_file() and not file.name.startswith(".")}
    assert names - held == set()
    assert {name.split("/")[0] for name in held if ".dist-info/" not in name} == set(PACKAGES)
    assert {card.removesuffix(".json") + ".safetensors" for card in cards} <= held
    assert {licence for folder, licence in licences if folder == "priors/weights"} == {"CC BY-NC 4.0"}
    assert {licence for folder, licence in licences if folder == "priors/weights/free"} <= {
        "free for any use",
        "CC0 1.0",
    }
    texts = f"mapctl-{__version__}.dist-info/licenses"
    assert {
        f"{texts}/{name}" for name in ("LICENSE", "priors/weights/LICENSE.md", "mapctl/examples/LICENSE.md")
    } <= held
    assert wheel.stat().st_size < 60e6
