"""Recordings of the live viewer: how long, how far their files are, broken off, given out again, and abandoned."""

import time

import pytest
import viser
from helpers import walk
from stage import run

from mapctl.errors import RequestError
from mapctl.skeleton import CANONICAL
from scenes.live import recording as recording_module
from scenes.live.export.controls import describe_length
from scenes.live.recording import ExportCancelled, ExportWork, Recording, encode_motion


def until(condition, seconds: float = 30.0) -> None:
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.02)


def recorded(show) -> None:
    show.toggle_recording(None)
    run(show, 4)
    show.toggle_recording(None)
    run(show, 1)


@pytest.mark.slow
def test_a_film_counts_its_frames():
    work = ExportWork()
    assert encode_motion(walk(4), "gif", None, work)[:3] == b"GIF"
    assert (work.done, work.total) == (4, 4)


def test_what_is_broken_off_ends_soon_and_leaves_no_file():
    work, began = ExportWork(is_cancelled=True), time.monotonic()
    with pytest.raises(ExportCancelled):
        encode_motion(walk(60), "mp4", None, work)
    assert time.monotonic() - began < 10


@pytest.mark.slow
def test_a_long_file_is_written_by_another_process(monkeypatch, tmp_path):
    monkeypatch.setattr(recording_module, "_LONG_FRAMES", 3)
    written = encode_motion(walk(5), "bvh")
    monkeypatch.setattr(recording_module, "_LONG_FRAMES", 900)
    assert written == encode_motion(walk(5), "bvh")


@pytest.mark.slow
def test_the_page_counts_and_shows_how_far_a_file_is_and_the_last_one_can_be_had_again(show, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    controls, made = show._panel.recording, []

    def slowly(motion, ending, drawn=None, work=None):
        work.total = 10
        while work.done < 10:
            time.sleep(0.01)
            if work.is_cancelled:
                raise ExportCancelled
            work.done = work.done + 1 if made else 4  # the first time it hangs there
        return b"film"

    monkeypatch.setattr(recording_module, "encode_motion", slowly)
    with pytest.raises(RequestError, match="nothing was recorded yet"):
        show._recorder.save_again("bvh", None)
    controls.ending.value = "mp4"
    show.toggle_recording(None)
    run(show, 4)
    show._label_recording()
    assert controls._text.content == "● **0:00.4, 12 frames**"
    show.toggle_recording(None)
    run(show, 1)
    until(lambda: show._recorder.work is not None and show._recorder.work[1].done == 4)
    show._label_recording()
    assert controls._text.content.startswith("Making mapctl.mp4, 4 of 10 frames")
    assert (controls._bar.visible, controls._bar.value, controls._cancel.visible) == (True, 40.0, True)
    show.cancel_export()
    until(lambda: show._recorder.work is None)
    assert list(tmp_path.iterdir()) == []
    made.append(1)
    show._label_recording()
    assert controls._text.content.startswith("Last: 0:00.")
    assert controls._again.visible
    show.save_again(None)
    run(show, 1)
    until(lambda: show._recorder.work is None)
    assert (tmp_path / "mapctl.mp4").read_bytes() == b"film"


@pytest.mark.slow
def test_files_are_made_in_turn_and_only_the_last_recording_is_kept(show, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    show._recorder._folder = tmp_path
    recorded(show)
    first = show._recorder.last
    recorded(show)
    until(lambda: show._recorder.work is None)
    assert show._recorder.last is not first
    names = sorted(path.name for path in tmp_path.iterdir())
    assert names == ["mapctl-2.bvh", "mapctl-2.recording", "mapctl.bvh"]
    show._recorder.close()
    assert not list(tmp_path.glob("*.recording"))


class Leaver:
    """A browser that goes away when a file is sent to it."""

    client_id = 7

    def send_file_download(self, *given, **named):
        raise ConnectionError("it went away")


@pytest.mark.slow
def test_a_browser_that_leaves_in_the_middle_loses_nothing(show, monkeypatch, tmp_path, capsys):
    monkeypatch.chdir(tmp_path)
    leaver = Leaver()
    monkeypatch.setattr(show.server, "get_clients", lambda: dict[int, viser.ClientHandle]({7: leaver}))
    show.toggle_recording(None)
    run(show, 2)
    monkeypatch.setattr(show.server, "send_file_download", leaver.send_file_download)
    show.toggle_recording(None)
    run(show, 1)
    until(lambda: show._recorder.work is None)
    assert (tmp_path / "mapctl.bvh").stat().st_size > 1000
    assert "went away" not in capsys.readouterr().err


def test_lengths_are_described():
    recording = Recording(CANONICAL)
    assert describe_length(recording) == "0:00.0, 0 frames"
    recording._writer = type("Writer", (), {"frames": 1869})()
    assert describe_length(recording) == "1:02.3, 1869 frames"
