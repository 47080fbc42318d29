"""`mapctl steer` and `mapctl live` with programs at the other end, as a user types it."""

import functools
import json
import os
import signal
import socket
import subprocess
import sys
import time
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
from helpers import run
from listening import engine, free_ports
from pythonosc.udp_client import SimpleUDPClient
from tiny_stitcher import save_tiny_stitcher

import mapctl
import priors
from controllers.steering.process import CharacterProcess, CharacterRequest
from mapctl.commands import live
from mapctl.intent.steering import Command
from mapctl.skeleton import CANONICAL
from scenes.live.app import LiveApp

ROOT = Path(__file__).resolve().parents[2]
SCRIPT = "time_s,speed_mps,heading_deg\n0,1.2,0\n0.5,1.0,40\n1.5,1.0,40\n"
ALLOWED = 1 / 30  # seconds: of a frame's own time


def joints_of(path: Path) -> np.ndarray:
    """A file's joints in canonical order."""
    motion = mapctl.load(path)
    return motion.joint_positions()[:, [motion.skeleton.index(name) for name in CANONICAL.names]].numpy()


@pytest.fixture
def script(tmp_path) -> Path:
    path = tmp_path / "script.csv"
    path.write_text(SCRIPT)
    return path


@pytest.mark.slow
@pytest.mark.parametrize("more", [(), ("--stream-root", "--stream-delay", "0")])
def test_the_joints_of_a_script_are_rebuilt_from_its_stream(script, prior, tmp_path, capsys, more):
    port, out, report = free_ports(1), tmp_path / "out.npz", tmp_path / "report.json"
    with engine(port) as listener:
        words = ("steer", script, "-o", out, "--prior", prior, "--realtime", "--report", report, "--stream", f":{port}")
        assert run(*words, *more) == 0
        listener.wait(45)
    joints = joints_of(out)
    assert joints.shape == (45, 21, 3)
    assert np.abs(listener.joints() - joints).max() < 0.001
    assert [frame.seconds for frame in listener.frames] == pytest.approx(np.arange(45) / 30, abs=1e-5)
    travels = max(np.abs(frame.root_position).max() for frame in listener.frames) > 0.01
    assert travels == bool(more)
    sent = json.loads(report.read_text())["timing"]["stream"]
    assert (sent["frames_sent"], sent["not_sent"]) == (45, 0)
    assert f"45 frames to 127.0.0.1:{port}" in capsys.readouterr().out


@pytest.fixture
def other():
    """The port that another program holds."""
    with closing(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) as held:
        held.bind(("127.0.0.1", 0))
        yield held.getsockname()[1]


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("--stream", "39539"), "--stream goes by the clock, which needs --realtime"),
        (("--realtime", "--stream", "host"), "--stream must be HOST:PORT"),
        (("--realtime", "--stream", ":99999"), "--stream must be HOST:PORT"),
        (("--realtime", "--stream", "no such.host:1"), "the host 'no such.host' is not known"),
        (("--realtime", "--stream-root"), "--stream-root is an option of --stream"),
        (("--realtime", "--stream", "1", "--stream-delay", "-1"), "--stream-delay must be 0 to 5 seconds, got -1"),
        (("--realtime", "--stream", "1", "--stream-delay", "nan"), "--stream-delay must be 0 to 5 seconds"),
    ],
)
def test_a_script_cannot_be_streamed_so(fails, tmp_path, prior, words, said):
    (tmp_path / "c.csv").write_text(SCRIPT)
    assert said in fails("steer", "c.csv", "-o", "a.bvh", "--prior", prior, *words)


def test_a_port_that_is_taken_is_one_line(fails, other):
    assert f"port {other} of 127.0.0.1 is in use by another program" in fails("live", "--listen", other)


@pytest.mark.slow
def test_characters_obey_what_comes_over_osc_and_their_poses_go_out(prior, tmp_path, monkeypatch, capsys):
    """The whole of `mapctl live` but the browser: two characters in their processes, on tiny models."""
    stitcher = functools.partial(priors.load_stitcher, str(save_tiny_stitcher(tmp_path / "s.safetensors")))

    def start(command, drawn, opened):
        load = functools.partial(priors.load, prior)
        requests = [CharacterRequest(load, Command(1.2, 0.0), at=(3.0 * k, 0.0), transitions=stitcher) for k in (0, 1)]
        result = [CharacterProcess(request) for request in requests]
        for one in result:
            one.wait()
        return result

    ports, listen = free_ports(2), free_ports(3) + 2
    hand, shoulder = CANONICAL.index("leftHand"), CANONICAL.index("leftUpperArm")
    with engine(ports) as first, engine(ports + 1) as second, SimpleUDPClient("127.0.0.1", listen) as client:

        def wait(show, seconds):
            end = time.perf_counter() + seconds
            loop(show, lambda: time.perf_counter() > end)

        def play(show):
            client.send_message("/mapctl/2/speed", 0.0)
            wait(show, 1.0)
            play.asked, play.target = len(second.frames), second.joints()[-1, shoulder] + [0.3, 0.2, 0.1]
            client.send_message("/mapctl/2/hand/left", play.target.tolist())
            wait(show, 2.0)
            play.held = [character.inputs for character in show.characters]
            raise KeyboardInterrupt

        loop = LiveApp.run
        monkeypatch.setattr(live, "_start_characters", start)
        monkeypatch.setattr(LiveApp, "run", play)
        words = ("live", "--port", 8180, "--prior", prior, "--characters", 2)
        assert run(*words, "--stream", ports, "--listen", listen) == 0
    assert [orders.reach for orders in play.held] == [{}, {"left": pytest.approx(tuple(play.target))}]
    assert play.held[1].speed == 0.0
    assert min(len(first.frames), len(second.frames)) > 30
    assert all(np.all(np.diff([f.seconds for f in one.frames]) > 0) for one in (first, second))
    away = np.linalg.norm(second.joints()[play.asked - 1 :, hand] - play.target, axis=-1)
    assert away.min() < 0.5 * away[0], "its hand goes to what was ordered"
    assert np.abs(first.joints()[0, 0, 0]) < 0.5 < second.joints()[0, 0, 0]
    out = capsys.readouterr().out
    assert f"poses go to 127.0.0.1:{ports}, 127.0.0.1:{ports + 1} (VMC)" in out
    assert f"orders come from 127.0.0.1:{listen} (OSC)" in out
    assert "late, at most" in out


def start_command(*words: object) -> subprocess.Popen:
    environment = os.environ | {"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    return subprocess.Popen(
        [sys.executable, "-m", "mapctl", *map(str, words)], env=environment, stdout=subprocess.PIPE, text=True
    )


@pytest.mark.slow
def test_a_character_follows_its_osc_commands(tmp_path):
    """`mapctl live` as it is, for 15 seconds, with the bundled prior; Ctrl-C ends it."""
    port, listen = free_ports(1), free_ports(3) + 2
    with engine(port) as listener, SimpleUDPClient("127.0.0.1", listen) as client:
        show = start_command("live", "--port", 8190, "--stream", port, "--listen", listen)
        try:
            listener.wait(60, seconds=120)
            client.send_message("/mapctl/heading", 90.0)
            client.send_message("/mapctl/speed", 1.5)
            begun = len(listener.frames)
            listener.wait(begun + 210)
            client.send_message("/mapctl/speed", 0.0)
            listener.wait(begun + 330)
        finally:
            show.send_signal(signal.SIGINT)
            out, _ = show.communicate(timeout=60)
    hips = listener.joints()[:, 0]
    way = hips[begun + 200] - hips[begun + 80]
    assert way[0] / 4 == pytest.approx(1.5, abs=0.2), "m/s along +X"
    assert abs(way[2]) < 0.6
    assert np.linalg.norm(hips[begun + 320] - hips[begun + 300]) < 0.1
    assert listener.lateness().max() < ALLOWED
    assert ", 0 late" in out
