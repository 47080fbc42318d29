"""What was recorded when the program was killed is there."""

import io
import os
import subprocess
import sys
import time
from pathlib import Path

import pytest
from helpers import run as run_command
from stage import delivered, run

from mapctl import formats
from mapctl.skeleton import CANONICAL
from scenes.live.recording import Recording

RECORDS = """
import time, sys
sys.path.insert(0, {tests!r})
from pathlib import Path
from stage import delivered
from mapctl.skeleton import CANONICAL
from scenes.live.recording import Recording
recording = Recording(CANONICAL, folder=Path.cwd())
for first in range(0, 60, 3):
    recording.add(delivered(first))
print("added", flush=True)
time.sleep(60)
"""


class Full(io.FileIO):
    """A file on a disk that is full."""

    def write(self, content):
        raise OSError(28, "No space left on device")


@pytest.mark.slow
def test_a_program_that_is_killed_loses_no_frame(tmp_path):
    script = RECORDS.format(tests=str(Path(__file__).parents[1]))
    with subprocess.Popen([sys.executable, "-c", script], cwd=tmp_path, stdout=subprocess.PIPE, text=True) as made:
        assert made.stdout is not None
        assert made.stdout.readline() == "added\n"
        made.kill()  # SIGKILL
    assert run_command("convert", tmp_path / "mapctl.recording", tmp_path / "saved.bvh") == 0
    assert formats.load(tmp_path / "saved.bvh").num_frames == 60


def test_recordings_replace_none_and_go_when_they_are_kept_elsewhere(tmp_path):
    made = [Recording(CANONICAL, folder=tmp_path) for _ in range(2)]
    assert list(tmp_path.iterdir()) == [], "there is no file without a frame"
    for recording in made:
        recording.add(delivered())
    assert sorted(path.name for path in tmp_path.iterdir()) == ["mapctl-2.recording", "mapctl.recording"]
    assert [recording.frames for recording in made] == [3, 3]
    assert made[0].seconds == pytest.approx(0.1)
    for recording in made:
        recording.motion()
        recording.discard()
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
def test_a_delivered_recording_leaves_no_file_and_a_lost_one_is_told(show, capsys, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    show._recorder._folder = tmp_path
    show.toggle_recording(None)
    run(show, 3)
    assert (tmp_path / "mapctl.recording").exists()
    show.toggle_recording(None)
    run(show, 3)
    until = time.monotonic() + 10
    while show._recorder.work is not None and time.monotonic() < until:
        time.sleep(0.02)
    show._recorder.close()  # until then it can be had again
    assert [path.name for path in tmp_path.iterdir()] == ["mapctl.bvh"]

    recording = Recording(CANONICAL, folder=tmp_path)
    recording.add(delivered())
    monkeypatch.setattr(Recording, "motion", lambda _: 1 / 0)
    show._recorder._delivery.export(recording, "bvh", None)
    assert f"what was recorded is in {tmp_path / 'mapctl.recording'}" in capsys.readouterr().err


@pytest.mark.slow
def test_a_disk_that_is_full_ends_the_recording_and_is_said(show, actors):
    show.toggle_recording(None)
    run(show, 3)
    recording = show._cast.members[0].recording
    recording._writer._file = Full(os.dup(recording._file.fileno()), "r+")
    run(show, 3)
    assert "The recording of character 1 has stopped: No space left on device" in show._notices._top.content
    assert recording.motion().num_frames == recording.frames == 9
