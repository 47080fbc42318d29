"""What the packages' import costs: no more than what they compute with."""

import subprocess
import sys


def test_torchs_compiler_is_not_imported():
    """roma would import it, a third of the whole time, for functions that nothing here uses."""
    script = (
        "import sys\nimport mapctl, priors, controllers, mapctl.rotations\n"
        "print([name for name in sys.modules if name.startswith(('torch._dynamo', 'torch._inductor'))])"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=120)
    assert (done.returncode, done.stdout) == (0, "[]\n"), done.stderr
