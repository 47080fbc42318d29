"""The shape of the project: who imports whom, and what no file may hold."""

import ast
import re
import tomllib
from pathlib import Path

import pytest
from source_files import FILES, MAY_IMPORT, PACKAGE_FILES, ROOT, imports, tree_of

CLI = Path("mapctl/cli.py")
START = Path("mapctl/__main__.py")  # of the command line, before anything is imported
COMMANDS = Path("mapctl/commands")  # one file a sub-command: the rest of the command line
UNPICKLERS = {"pickle", "cPickle", "_pickle", "dill", "cloudpickle", "shelve", "marshal", "joblib"}
PROCESSES = {"joblib", "joblib.Parallel", "joblib.delayed"}  # of an unpickler, what reads no files
FLOORS = {
    "mapctl": (
        "blender isolated joint_ranges mesh numerics solver",
        "contacts kinematics",
        "formats",
        "curves retarget",
        "editing intent motion_dna recording terms",
        "inbetweening problem runtime",
        "metrics streaming",
        "commands",
    ),
    "controllers": ("common", "following", "denoising generation inbetweening steering", "shots"),
}
"""Rooms from the ground up: each imports only from those on lower floors, and its own."""


def direction_faults(file: Path, tree: ast.Module) -> set[str]:
    """The imports that point the wrong way."""
    if file in (CLI, START):
        return set()
    wires = file.is_relative_to(COMMANDS)
    banned = set() if wires else MAY_IMPORT.keys() - MAY_IMPORT[file.parts[0]]
    above = r"mapctl\.cli(\.|$)" if wires else r"mapctl\.(cli|commands)(\.|$)"
    names = imports(file, tree)
    return {name for name in names if name.partition(".")[0] in banned or re.match(above, name)}


def content_faults(tree: ast.Module) -> list[str]:
    """Bare excepts and everything that unpickles, with lines."""
    faults = []
    for node in ast.walk(tree):
        if isinstance(node, ast.ExceptHandler) and node.type is None:
            faults.append(f"line {node.lineno}: bare except")
        elif isinstance(node, ast.Call) and ast.unparse(node.func) in ("torch.load", "joblib.load"):
            faults.append(f"line {node.lineno}: {ast.unparse(node.func)} unpickles")
        elif isinstance(node, ast.keyword) and node.arg == "allow_pickle" and ast.unparse(node.value) != "False":
            faults.append(f"line {node.value.lineno}: allow_pickle")
    return faults


@pytest.mark.parametrize("file", PACKAGE_FILES, ids=str)
def test_imports_point_one_way(file):
    assert direction_faults(file, tree_of(file)) == set()


@pytest.mark.parametrize("file", FILES, ids=str)
def test_file_is_safe(file):
    tree = tree_of(file)
    assert content_faults(tree) == []
    assert {name for name in imports(file, tree) - PROCESSES if name.partition(".")[0] in UNPICKLERS} == set()


@pytest.mark.parametrize(
    ("file", "source"),
    [
        ("mapctl/problem/receding_horizon.py", "import priors.lstm_gmm.network"),
        ("mapctl/formats/bvh/__init__.py", "def late():\n    from controllers import follow"),
        ("mapctl/motion.py", "from importlib import import_module\nimport_module('scenes.film')"),
        ("priors/layers.py", "from controllers.following.follow import follow"),
        ("scenes/live.py", "from mapctl import cli"),
        ("controllers/following/follow.py", "import mapctl.cli as cli"),
        ("mapctl/terms/path.py", "from ..cli import main"),
        ("mapctl/report.py", "from mapctl.commands import follow"),
        ("scenes/film.py", "import mapctl.commands.shared.path_walk"),
        ("mapctl/commands/follow.py", "from mapctl.cli import main"),
        ("mapctl/terms/__init__.py", "from ...priors import load"),
    ],
)
def test_wrong_imports_are_seen(file, source):
    assert direction_faults(Path(file), ast.parse(source))


@pytest.mark.parametrize(
    ("file", "source"),
    [
        ("mapctl/cli.py", "import priors, controllers, scenes"),
        ("mapctl/commands/follow.py", "import priors\nfrom mapctl.commands import walks"),
        ("mapctl/terms/path.py", "from ..curves import Curve\nfrom . import noise"),
        ("scenes/film.py", "import scenes.cameras\nfrom mapctl.motion import Motion\nimport numpy"),
    ],
)
def test_right_imports_pass(file, source):
    assert direction_faults(Path(file), ast.parse(source)) == set()


def floor_of(package: str, name: str) -> int | None:
    """Of a module's room; None where it is in none."""
    parts = name.split(".")
    room = parts[1] if parts[0] == package and len(parts) > 1 else ""
    return next((floor for floor, rooms in enumerate(FLOORS[package]) if room in rooms.split()), None)


def floor_faults(package: str, file: Path, tree: ast.Module) -> list[str]:
    """What a module imports from a room on its own floor or above."""
    own, room = floor_of(package, ".".join(file.with_suffix("").parts)), file.parts[1]
    return [
        name
        for name in imports(file, tree)
        if own is not None and (floor := floor_of(package, name)) is not None
        if name.split(".")[1] != room and floor >= own
    ]


@pytest.mark.parametrize("package", FLOORS)
def test_rooms_stand_on_those_below(package):
    files = [file for file in PACKAGE_FILES if file.parts[0] == package]
    assert {file.parts[1] for file in files if len(file.parts) > 2} == set(" ".join(FLOORS[package]).split())
    assert [f"{file}: {name}" for file in files for name in floor_faults(package, file, tree_of(file))] == []


@pytest.mark.parametrize(
    ("file", "source"),
    [
        ("mapctl/kinematics/inverse.py", "from mapctl.problem import objective"),
        ("mapctl/terms/path.py", "from mapctl.recording import masks"),
        ("controllers/common/score.py", "def late():\n    from controllers.steering import steer"),
    ],
)
def test_a_room_that_reaches_up_is_seen(file, source):
    assert floor_faults(file.split("/")[0], Path(file), ast.parse(source))


def test_unsafe_lines_are_seen():
    source = "try:\n    torch.load(p)\nexcept:\n    np.load(p, allow_pickle=True)"
    assert {fault.split(":")[0] for fault in content_faults(ast.parse(source))} == {"line 2", "line 3", "line 4"}


def requirements() -> dict[str, list[str]]:
    """Distribution names by extra; the base ones under ''."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    groups = {"": project["dependencies"], **project["optional-dependencies"]}
    return {extra: [re.split(r"[^\w.-]", line)[0] for line in lines] for extra, lines in groups.items()}


def test_what_setup_installs_is_pinned():
    lines = (ROOT / "constraints.txt").read_text("utf-8").splitlines()
    pins = dict(line.split("==") for line in lines if line and not line.startswith("#"))
    installed = ("", "render", "live", "usd", "fbx", "stream", "dev", "docs")
    needed = {name for extra in installed for name in requirements()[extra]}
    assert needed == pins.keys()


def test_pyopengl_is_left_to_pyrender():
    assert "pyopengl" not in {name.lower() for names in requirements().values() for name in names}
