"""Characters that share a process' memory: from a script as it stands, small, and started again by themselves."""

import functools
import os
import signal
import subprocess
import sys
import time

import pytest
from tiny_prior import save_tiny_prior

import priors
from controllers.steering import process_worker
from controllers.steering.process import CharacterProcess, CharacterRequest
from mapctl.intent.steering import Command
from mapctl.runtime import forking

pytestmark = pytest.mark.skipif(not forking.AVAILABLE, reason="processes are forked on Linux only")

SCRIPT = """
import functools, os, time
import priors
from controllers.steering.process import CharacterProcess, CharacterRequest
from mapctl.intent.steering import Command
from mapctl.runtime.memory import measure_own_memory_mb
{loader}
crowd = [CharacterProcess(CharacterRequest(load, Command(1.2, 0.0), seed)) for seed in range(3)]
for one in crowd:
    one.wait()
time.sleep(1.5)
frames = [sum(len(chunk.root) for chunk in one.poll()) for one in crowd]
print(min(frames), max(measure_own_memory_mb(one.pid) for one in crowd), len({{one.base_pid for one in crowd}}))
for one in crowd:
    one.close()
"""


def run_script(loader: str, folder) -> tuple[float, float, int]:
    done = subprocess.run(
        [sys.executable, "-c", SCRIPT.format(loader=loader)],
        capture_output=True,
        text=True,
        timeout=120,
        cwd=folder,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
    )
    assert done.returncode == 0, done.stderr
    frames, memory, bases = done.stdout.split()
    return float(frames), float(memory), int(bases)


@pytest.mark.slow
def test_a_script_needs_no_main_guard_and_a_character_is_small(tmp_path):
    path = save_tiny_prior(tmp_path / "tiny.safetensors")
    frames, memory, bases = run_script(f"load = functools.partial(priors.load, {str(path)!r})", tmp_path)
    assert frames >= 3
    assert memory < 60  # MB: alone it would be 350
    assert bases == 1


@pytest.mark.slow
def test_who_ends_is_started_again_from_the_same_process_or_a_new_one(tmp_path):
    load = functools.partial(priors.load, str(save_tiny_prior(tmp_path / "tiny.safetensors")))
    request = CharacterRequest(load, Command(1.0, 0.0))
    with CharacterProcess(request) as other, CharacterProcess(request) as lost:
        lost.wait()
        other.wait()
        first = lost.pid
        os.kill(lost.base_pid, signal.SIGKILL)
        os.kill(first, signal.SIGKILL)
        until = time.perf_counter() + 10
        while not lost._failed and time.perf_counter() < until:
            time.sleep(0.02)
        lost.reset()
        lost.wait()
        assert lost.pid != first
        time.sleep(0.5)
        assert other.poll()
        assert lost.poll()


def test_those_that_begin_together_take_turns(monkeypatch):
    now, slept = [1234.567], []
    monkeypatch.setattr(process_worker.time, "perf_counter", lambda: now[0])
    monkeypatch.setattr(process_worker.time, "sleep", slept.append)
    for pid in range(4000, 4008):
        monkeypatch.setattr(process_worker.os, "getpid", lambda pid=pid: pid)
        process_worker._wait_for_turn(0.1)
    turns = sorted((now[0] + one) % 0.1 for one in slept)
    gaps = [b - a for a, b in zip(turns, [*turns[1:], turns[0] + 0.1], strict=True)]
    assert all(0 <= one <= 0.1 for one in slept)
    assert min(gaps) > 0.007, "eight within 0.1 s"
