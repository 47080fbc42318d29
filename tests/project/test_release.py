"""What a release says of itself agrees, and its sdist holds what builds, tests and documents it."""

import re
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from mapctl import __version__

ROOT = Path(__file__).resolve().parents[2]
PROSE = (
    "CHANGELOG.md",
    "CONTRIBUTING.md",
    "SECURITY.md",
    *(f".github/{name}" for name in ("pull_request_template.md",)),
)
LEFT_OUT = shutil.ignore_patterns("__pycache__", ".git", ".venv", "_build", "*.egg-info", "*.safetensors", ".*_cache")


def read(name: str) -> str:
    return (ROOT / name).read_text("utf-8")


@pytest.fixture(scope="module")
def sources(tmp_path_factory) -> set[str]:
    """The files that setuptools puts into the sdist, of a copy without the weights themselves."""
    copy = tmp_path_factory.mktemp("sdist") / "mapctl"
    shutil.copytree(ROOT, copy, ignore=LEFT_OUT)
    command = [sys.executable, "-c", "from setuptools import setup; setup()", "-q", "egg_info"]
    done = subprocess.run(command, cwd=copy, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return set((copy / "mapctl.egg-info" / "SOURCES.txt").read_text("utf-8").splitlines())


def test_the_version_is_said_in_one_place():
    assert re.fullmatch(r"\d+\.\d+\.\d+", __version__)
    project = tomllib.loads(read("pyproject.toml"))
    assert project["project"]["dynamic"] == ["version"]
    assert project["tool"]["setuptools"]["dynamic"]["version"] == {"attr": "mapctl.version.__version__"}
    packages = [file for name in ("mapctl", "priors", "controllers", "scenes") for file in (ROOT / name).rglob("*.py")]
    literal = re.compile(rf"['\"]{re.escape(__version__)}['\"]")
    assert [file.relative_to(ROOT).as_posix() for file in packages if literal.search(file.read_text("utf-8"))] == [
        "mapctl/version.py"
    ]


def test_the_citation_is_of_this_version():
    assert re.search(r"^version: (\S+)$", read("CITATION.cff"), re.M)[1] == __version__


def test_the_change_log_begins_with_this_version():
    heads = re.findall(r"^## \[(.+?)\] - (\d{4}-\d{2}-\d{2}|Unreleased)$", read("CHANGELOG.md"), re.M)
    assert heads[0][0] == __version__
    assert len(heads) == read("CHANGELOG.md").count("\n## ")
    assert [version for version, day in heads[1:] if day == "Unreleased"] == []


def test_the_four_papers_are_cited_as_the_page_of_references_does():
    page, citation = read("docs/reference/references.md"), read("CITATION.cff")
    table = page[page.index("## The four papers") : page.index("## Methods")]
    titles = re.findall(r"^\| [^|]+ \| [^:|]+: (.+?)\. [^|]+\|", table, re.M)
    assert len(titles) == 4
    assert [title for title in titles if title not in citation] == []


@pytest.mark.parametrize("page", PROSE)
def test_files_that_are_linked_are_there(page):
    links = re.findall(r"\]\(([^)#:]+)(?:#[^)]*)?\)", read(page))
    assert [link for link in links if not (ROOT / Path(page).parent / link).exists()] == []


@pytest.mark.slow
def test_the_sdist_builds_tests_and_documents(sources):
    made = {"__pycache__", "_build", "auto_gallery", "made", "sg_execution_times.rst"}
    wanted = [
        path.relative_to(ROOT).as_posix()
        for folder in ("mapctl", "priors", "controllers", "scenes", "tests", "docs", ".ci", ".github")
        for path in (ROOT / folder).rglob("*")
        if path.is_file() and not made & {*path.parts} and path.suffix != ".safetensors"
    ]
    wanted += [*PROSE, "CITATION.cff", "LICENSE", "Makefile", "README.md", "constraints.txt", "pyproject.toml"]
    assert len(wanted) > 1000
    assert {*wanted} - sources == set()
