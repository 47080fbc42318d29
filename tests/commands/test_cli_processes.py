"""The command line in a process of its own: `--help` imports nothing heavy, signals and closed pipes end it cleanly."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

import mapctl


def _started(words) -> subprocess.Popen[str]:
    """mapctl in a process that heeds Ctrl-C, also where the tests run in the background and ignore it."""
    return subprocess.Popen(
        [sys.executable, "-m", "mapctl.cli", *map(str, words)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )


def _ended(process: subprocess.Popen[str]) -> tuple[str, str]:
    """What it said in the end; it is killed if it does not end."""
    try:
        return process.communicate(timeout=60)
    except subprocess.TimeoutExpired:
        process.kill()
        raise


@pytest.mark.parametrize(
    ("number", "said"),
    [
        (signal.SIGINT, (130, "mapctl: interrupted\n")),
        pytest.param(signal.SIGTERM, (143, "mapctl: terminated\n"), marks=pytest.mark.slow),
    ],
)
def test_interruption_leaves_nothing_half_done(prior, tmp_path, number, said):
    """Ctrl-C or SIGTERM in the middle of hours of motion: no traceback, no file, no folder."""
    words = ("generate", "-o", tmp_path / "gen", "--seconds", 36_000, "--prior", prior)
    process = _started(words)
    while not (tmp_path / "gen").exists() and process.poll() is None:
        time.sleep(0.1)
    time.sleep(0.5)  # by then it samples
    process.send_signal(number)
    process.send_signal(number)  # `timeout` sends it twice
    _, told = _ended(process)
    assert (process.returncode, told) == said
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
def test_a_walk_interrupted_from_outside_leaves_a_whole_file_or_none(prior, tmp_path):
    words = ("follow", "circle:4", "-o", tmp_path / "walk.bvh", "--seconds", 3000, "--prior", prior)
    process = _started(words)
    time.sleep(5)
    process.send_signal(signal.SIGTERM)
    _, told = _ended(process)
    assert process.returncode == 143
    assert "Traceback" not in told
    assert told.startswith("mapctl: terminated")
    written = (tmp_path / "walk.bvh").exists()
    assert written == ("what was solved until then is written" in told)
    assert not written or 2 < mapctl.load(tmp_path / "walk.bvh").num_frames < 90_000


@pytest.mark.slow
def test_a_closed_pipe_is_no_error():
    """As in `mapctl measure walk.bvh | head -1`."""
    reader, writer = os.pipe()
    os.close(reader)
    done = subprocess.run(
        [sys.executable, "-m", "mapctl.cli", "--version"], stdout=writer, stderr=subprocess.PIPE, timeout=120
    )
    os.close(writer)
    assert b"Traceback" not in done.stderr
    assert done.returncode == 1


def test_a_full_disk_for_what_is_printed_is_one_line():
    with Path("/dev/full").open("wb") as full:
        done = subprocess.run(
            [sys.executable, "-m", "mapctl.cli", "--version"], stdout=full, stderr=subprocess.PIPE, timeout=120
        )
    assert (done.returncode, done.stderr) == (2, b"mapctl: input or output: No space left on device\n")
