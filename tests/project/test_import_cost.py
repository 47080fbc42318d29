"""What imports cost: no more than the packages compute with; slow or optional libraries wait for their first use."""

import ast
import subprocess
import sys
from importlib import import_module
from pathlib import Path

import pytest
from source_files import tree_of

LATE = (
    "torch._dynamo",
    "torch._inductor",
    "pyswarms",
    "pygltflib",
    "pxr",
    "matplotlib",
    "PIL",
    "pyrender",
    "ray",
    "pythonosc",
)


FOLLOW_LATE = (
    *LATE,
    "sympy",
    "scipy.interpolate",
    "scipy.linalg",
    "scipy.optimize",
    "scipy.signal",
    "scipy.sparse",
    "scipy.spatial",
    "scipy.stats",
    "pydantic",
    "rich",
    "svgpathtools",
    "numba.np.arraymath",  # of the compiler, for which numba imports all of scipy.linalg
    "numba.typed.typedlist",
    "controllers.denoising.denoise",
    "controllers.inbetweening.pipeline",
    "controllers.shots.shot",
    "priors.refiner.network",
    "priors.tweening.inbetweener",
    "mapctl.formats.usd",
    "scenes.film",
)
"""What a walk along a straight line needs none of."""
FACADES = ("mapctl", "priors", "controllers", "scenes")


def python(script: str) -> str:
    """Standard output of a fresh process."""
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.slow
def test_slow_libraries_are_not_imported():
    packages = "mapctl, priors, controllers, scenes, mapctl.rotations, mapctl.formats, mapctl.solver.swarm, scenes.film"
    script = f"import sys, {packages}\nprint([name for name in {LATE} if name in sys.modules])"
    assert python(script) == "[]\n"


@pytest.mark.slow
def test_a_walk_imports_what_it_uses(tmp_path):
    """With compiled kernels on disk, which the first command sees to."""
    script = (
        "import sys\nfrom mapctl.cli import main\n"
        f"assert main({['follow', 'line:1', '--seconds', '0.1', '--quiet', '-o', str(tmp_path / 'walk.bvh')]!r}) == 0\n"
        f"print([name for name in {FOLLOW_LATE} if name in sys.modules])"
    )
    python("import sys\nfrom mapctl.cli import main\nsys.exit(main(['compile', '--quiet']))")
    assert python(script) == "[]\n"


def test_help_waits_for_nothing_but_the_parser_of_commands():
    """Which packages it imports, not how long it takes: seconds depend on the machine."""
    script = (
        "import sys\nfound = set(sys.modules)\nfrom mapctl.cli import main\n"
        "try:\n    main(['--help'])\nexcept SystemExit:\n    pass\n"
        "new = {name.split('.')[0] for name in set(sys.modules) - found} - sys.stdlib_module_names\n"
        "print('PACKAGES', *sorted(new))"
    )
    assert python(script).split("PACKAGES ")[-1].split() == ["docstring_parser", "mapctl", "typing_extensions", "tyro"]


@pytest.mark.parametrize("package", FACADES)
def test_names_that_arrive_late_are_those_that_type_checkers_see(package):
    module = import_module(package)
    homes = module._HOMES
    tree = tree_of(Path(package) / "__init__.py")
    (seen,) = (node for node in tree.body if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING")
    assert homes.keys() == {alias.asname for node in seen.body for alias in node.names}
    for name in homes:
        assert getattr(module, name) is not None
    with pytest.raises(AttributeError, match="nothing_of_this_name"):
        _ = module.nothing_of_this_name


@pytest.mark.slow
def test_the_collector_is_off_until_a_command_has_imported():
    script = (
        "import gc, sys\nfrom mapctl import __main__\nfrom mapctl.commands.shared.command import Command\n"
        "from mapctl.runtime import garbage\nfound = []\n"
        "class Work(Command):\n    work = 'types_of_work'\n"
        "class Run:\n    @staticmethod\n    def run(command):\n"
        "        found.append((gc.isenabled(), gc.get_freeze_count() > 1000))\n        return 0\n"
        "sys.modules['types_of_work'] = Run\n"
        "garbage.pause_collection()\nfound.append((gc.isenabled(), gc.get_freeze_count() > 1000))\n"
        "Work().run()\nprint(found)"
    )
    assert python(script) == "[(False, False), (True, True)]\n"


def test_a_caller_without_a_collector_stays_without():
    script = "import gc\nfrom mapctl.runtime import garbage\ngc.disable()\ngarbage.resume_collection()\n"
    script += "print(gc.isenabled())"
    assert python(script) == "False\n"


@pytest.mark.slow
def test_a_motion_made_by_hand_can_be_saved(tmp_path):
    """Nothing has imported the formats until then."""
    path = str(tmp_path / "still.npz")
    script = (
        "import sys, torch\nfrom fractions import Fraction\n"
        "from mapctl.motion import Motion\nfrom mapctl.skeleton import CANONICAL\n"
        "still = torch.tensor([0.0, 0.0, 0.0, 1.0]).double().expand(2, CANONICAL.num_joints, 4)\n"
        "motion = Motion(CANONICAL, Fraction(30), torch.zeros(2, 3).double(), still)\n"
        "assert 'mapctl.formats' not in sys.modules\n"
        f"motion.save({path!r})\nimport mapctl\nprint(mapctl.load({path!r}).num_frames)"
    )
    assert python(script) == "2\n"
