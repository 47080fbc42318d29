"""Compiled kernels: what is kept on disk, and the command that compiles ahead."""

import os
import subprocess
import sys

import pytest

KERNEL = """
import sys
from mapctl.numerics import compilation, jit

entry, inner = jit.make_jit_decorators()

@entry
def twice(number):
    return number + number

heard = []
with compilation.tell(lambda *words: heard.append(words)):
    assert twice(21) == 42
    assert twice(22) == 44
    assert twice(1.5) == 3.0 if len(sys.argv) > 1 else True
print(heard, jit.find_folders(), "numba.np.arraymath" in sys.modules)
"""


def use_kernel(folder, *words: str) -> str:
    """Use the kernel of a file in a fresh process, with compiled code kept beside it."""
    script = folder / "kernel.py"
    if not script.exists():
        script.write_text(KERNEL)
    environment = os.environ | {"NUMBA_CACHE_DIR": str(folder / "kept"), "PYTHONPATH": os.pathsep.join(sys.path)}
    done = subprocess.run(
        [sys.executable, script, *words], capture_output=True, text=True, timeout=120, env=environment
    )
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


@pytest.mark.slow
def test_a_kernel_is_compiled_once_and_loads_without_the_compiler(tmp_path):
    assert use_kernel(tmp_path).startswith("[(1, 1, True), (1, 1, False)] ")
    again = use_kernel(tmp_path)
    assert again.startswith("[] ")
    assert str(tmp_path / "kept") in again
    assert again.endswith("False")


@pytest.mark.slow
@pytest.mark.parametrize("ending", ["nbi", "nbc"])
def test_damaged_code_is_compiled_anew(tmp_path, ending):
    use_kernel(tmp_path)
    for file in (tmp_path / "kept").rglob(f"*.{ending}"):
        file.write_bytes(b"")
    assert use_kernel(tmp_path).startswith("[(1, 1, True), (1, 1, False)] ")
    assert use_kernel(tmp_path).startswith("[] ")


@pytest.mark.slow
def test_no_job_compiles_after_the_command(tmp_path):
    environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path / "kept")}
    (tmp_path / "commands.csv").write_text("time_s,speed_mps,heading_deg\n0,1.2,0\n0.5,0,60\n")
    jobs = (
        "compile --quiet",
        "follow circle:1 --seconds 1 --start stand --quiet -o a.bvh",
        "steer commands.csv --quiet -o b.bvh",
        "generate --seconds 1 --quiet -o c",
    )
    kept = []
    for job in jobs:
        words = [sys.executable, "-m", "mapctl", *job.split()]
        subprocess.run(words, check=True, cwd=tmp_path, env=environment | {"PYTHONPATH": os.pathsep.join(sys.path)})
        kept.append({path: path.stat().st_mtime_ns for path in (tmp_path / "kept").rglob("*.nb?")})
    assert kept[0]
    assert all(files == kept[0] for files in kept)
