"""The installed program: its commands answer, its public names are there, whatever was imported before."""

import os
import subprocess
import sys
from importlib import import_module

import pytest
from helpers import run

from mapctl.commands import COMMANDS
from mapctl.commands.train import RECIPES


def python(*words: str, **environment: str) -> str:
    """Return standard output of a fresh process."""
    variables = os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))} | environment
    done = subprocess.run([sys.executable, *words], capture_output=True, text=True, timeout=120, env=variables)
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.parametrize("name", COMMANDS)
def test_help_is_shown(name, capsys):
    for words in ([name], *([name, kind] for kind in (RECIPES if name == "train" else ()))):
        with pytest.raises(SystemExit) as left:
            run(*words, "--help")
        assert not left.value.code
        assert f"mapctl {' '.join(words)}" in capsys.readouterr().out.replace("\n", " ")


def test_help_is_written_to_an_output_of_ascii_only():
    assert "follow" in python("-m", "mapctl", "--help", PYTHONIOENCODING="ascii")


@pytest.mark.parametrize("package", ["mapctl", "priors", "controllers", "scenes"])
def test_public_names_are_there(package):
    module = import_module(package)
    assert all(getattr(module, name) is not None for name in dir(module))
    with pytest.raises(AttributeError, match="nothing_of_this_name"):
        _ = module.nothing_of_this_name


@pytest.mark.slow
def test_a_motion_built_in_python_can_be_saved(tmp_path):
    """Nothing has imported the formats until then."""
    script = (
        "import torch\nfrom fractions import Fraction\n"
        "from mapctl.motion import Motion\nfrom mapctl.skeleton import CANONICAL\n"
        "still = torch.tensor([0.0, 0.0, 0.0, 1.0]).double().expand(2, CANONICAL.num_joints, 4)\n"
        "motion = Motion(CANONICAL, Fraction(30), torch.zeros(2, 3).double(), still)\n"
        "motion.save('still.npz')\nimport mapctl\nprint(mapctl.load('still.npz').num_frames)"
    )
    assert python("-c", f"import os\nos.chdir({str(tmp_path)!r})\n{script}") == "2\n"
