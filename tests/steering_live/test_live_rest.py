"""With nobody to look, everybody waits and the loop costs next to nothing; who comes finds them where they were."""

import os
import subprocess
import sys
import threading
import time

import pytest
from stage import Actor, live_app

from mapctl.runtime.memory import measure_processor_seconds


def run_for(show, seconds: float) -> None:
    until = time.perf_counter() + seconds
    show.run(lambda: time.perf_counter() > until)


def words(actor: Actor) -> list[tuple]:
    return [heard for heard in actor.heard if heard[0] == "pause"]


@pytest.fixture
def resting(actors, monkeypatch):
    """A viewer that rests, and its browsers."""
    clients: dict[int, object] = {}
    with live_app(actors, rests=True) as show:
        monkeypatch.setattr(show.server, "get_clients", lambda: clients)
        yield show, clients


@pytest.mark.slow
def test_without_a_browser_all_rest_at_no_cost_and_go_on_with_one(resting, actors):
    show, clients = resting
    run_for(show, 1.0)
    assert words(actors[0]) == [], "a page that is loaded again is away for a moment"
    run_for(show, 1.5)
    assert words(actors[0]) == words(actors[1]) == [("pause", True)]
    began = time.process_time()
    run_for(show, 2.5)
    assert time.process_time() - began < 0.05 * 2.5
    clients[1] = object()
    threading.Timer(0.1, lambda: show.enqueue(lambda: None)).start()  # as when one comes
    began = time.perf_counter()
    show.run(lambda: len(words(actors[0])) > 1)
    assert time.perf_counter() - began < 0.7, "who comes does not wait for the end of the rest"
    assert words(actors[1]) == [("pause", True), ("pause", False)]
    clients.clear()
    run_for(show, 2.5)
    assert words(actors[1])[2:] == [("pause", True)]


@pytest.mark.slow
def test_who_is_paused_stays_so_when_somebody_comes(resting, actors):
    show, clients = resting
    show.toggle_pause()
    run_for(show, 2.5)
    clients[1] = object()
    run_for(show, 0.1)
    assert words(actors[0]) == [("pause", True)]
    show.toggle_pause()
    run_for(show, 0.1)
    assert words(actors[0]) == [("pause", True), ("pause", False)]


def test_who_is_paused_while_nobody_looks_is_paused_for_who_comes(resting, actors):
    show, clients = resting
    run_for(show, 2.5)
    show.toggle_pause()
    clients[1] = object()
    run_for(show, 0.1)
    assert words(actors[0])[-1] == ("pause", True)


@pytest.mark.slow
def test_a_recording_goes_on_without_a_browser(resting, actors, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)  # nobody takes the file
    show, _ = resting
    show.toggle_recording(None)
    run_for(show, 2.5)
    assert words(actors[0]) == []
    show.toggle_recording(None)
    run_for(show, 0.5)
    assert words(actors[0]) == [("pause", True)]


class Sink:
    """A stream that takes everything, and a source that tells nothing."""

    dropped, fault = 0, ""

    def put(self, *given):
        pass

    def pause(self):
        pass

    def forget(self, character):
        pass

    def poll(self):
        return []


@pytest.mark.slow
@pytest.mark.parametrize("what", ["stream", "source"])
def test_other_programs_are_served_without_a_browser(what, actors):
    with live_app(actors, rests=True, **{what: Sink()}) as show:
        run_for(show, 2.5)
    assert words(actors[0]) == []


def children(pid: int) -> list[int]:
    """A process and all below it."""
    told = subprocess.run(["ps", "-o", "pid=", "--ppid", str(pid)], capture_output=True, text=True, check=False).stdout
    return [pid, *(below for child in told.split() for below in children(int(child)))]


@pytest.mark.slow  # the parts: above, and test_a_pause_stops_time in test_process.py
@pytest.mark.skipif(sys.platform != "linux", reason="needs /proc")
def test_the_command_costs_next_to_nothing_while_nobody_looks(prior):
    command = [sys.executable, "-m", "mapctl", "live", "--port", "8191", "--characters", "2", "--prior", str(prior)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as live:
        try:
            assert live.stdout is not None
            next(line for line in live.stdout if line.startswith("open "))
            time.sleep(4.0)
            everybody = children(live.pid)
            before = [measure_processor_seconds(pid) for pid in everybody]
            time.sleep(4.0)
            spent = sum(measure_processor_seconds(pid) for pid in everybody) - sum(before)
        finally:
            os.kill(live.pid, 2)
    assert len(everybody) >= 3
    assert spent < 0.05 * 4.0
