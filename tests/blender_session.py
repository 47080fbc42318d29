"""Blender for the tests of the add-on: a Python of its own with the wheel `bpy`, and what is run there."""

import json
import os
import subprocess
import sys
from functools import cache
from pathlib import Path

import numpy as np
import pytest

ROOT = Path(__file__).resolve().parents[1]
SCRIPTS = ROOT / "tests" / "blender"
PYTHON = Path(os.environ.get("BLENDER_PYTHON", ROOT / ".venv" / "blender" / "bin" / "python"))
"""A Python that has bpy: `make test` brings one, and BLENDER_PYTHON names another."""


@cache
def blender_is_there() -> bool:
    """Whether that Python is there, and Blender loads in it."""
    if not PYTHON.is_file():
        return False
    return subprocess.run([PYTHON, "-c", "import bpy"], capture_output=True, timeout=120).returncode == 0


needs_blender = pytest.mark.skipif(
    "not __import__('blender_session').blender_is_there()",
    reason=f"{PYTHON} has no bpy, which wants Python 3.11; see .ci/setup blender, or set BLENDER_PYTHON",
)


def run_in_blender(script: str, folder: Path, *words: object) -> tuple[dict, dict[str, np.ndarray]]:
    """Run a script of tests/blender in Blender, with its settings in the folder: what it wrote to facts.json and
    arrays.npz there."""
    environment = os.environ | {
        "BLENDER_USER_RESOURCES": str(folder / "blender"),
        "PYTHONPATH": os.pathsep.join((str(SCRIPTS), str(ROOT))),
        "PYTHONNOUSERSITE": "1",
    }
    command = [PYTHON, SCRIPTS / script, folder, sys.executable, *map(str, words)]
    done = subprocess.run(
        command, env=environment, cwd=folder, capture_output=True, text=True, timeout=280, stdin=subprocess.DEVNULL
    )
    assert done.returncode == 0, f"{done.stdout[-2000:]}\n{done.stderr[-4000:]}"
    arrays = folder / "arrays.npz"
    found = dict(np.load(arrays, allow_pickle=False)) if arrays.exists() else {}
    return json.loads((folder / "facts.json").read_text()), found
