"""What imports cost: no more than the packages compute with; slow or optional libraries wait for their first use."""

import subprocess
import sys

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


def python(script: str) -> str:
    """Standard output of a fresh process."""
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_slow_libraries_are_not_imported():
    """roma would import torch's compiler, a third of the whole time, for functions that nothing here uses."""
    packages = "mapctl, priors, controllers, scenes, mapctl.rotations, mapctl.formats, mapctl.solver.swarm, scenes.film"
    script = f"import sys, {packages}\nprint([name for name in {LATE} if name in sys.modules])"
    assert python(script) == "[]\n"


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
