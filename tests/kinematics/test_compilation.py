"""The command that compiles kernels ahead of their first use."""

import os
import subprocess
import sys

import pytest

from mapctl.numerics.jit import make_jit_decorators


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


def test_a_kernel_without_a_folder_to_be_kept_in_is_compiled_all_the_same():
    namespace: dict = {}
    exec(compile("def twice(number):\n    return number + number\n", "no-such-folder/kernel.py", "exec"), namespace)
    entry, _ = make_jit_decorators()
    assert entry(namespace["twice"])(21) == 42
