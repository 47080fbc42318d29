"""Characters that share a process' memory are started again by themselves, and take turns."""

import functools
import os
import signal
import time

import pytest
from tiny_prior import save_tiny_prior

import priors
from controllers.steering import process, process_worker
from controllers.steering.process import CharacterProcess, CharacterRequest
from mapctl.intent.steering import Command
from mapctl.runtime import forking

pytestmark = pytest.mark.skipif(not forking.AVAILABLE, reason="processes are forked on Linux only")


@pytest.mark.slow
def test_who_ends_is_started_again_from_the_same_process_or_a_new_one(tmp_path):
    load = functools.partial(priors.load, str(save_tiny_prior(tmp_path / "tiny.safetensors")))
    request = CharacterRequest(load, Command(1.0, 0.0))
    with CharacterProcess(request) as other, CharacterProcess(request) as lost:
        lost.wait()
        other.wait()
        first = lost.pid
        os.kill(process._BASES.pid(lost._base), signal.SIGKILL)
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
