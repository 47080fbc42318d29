"""`mapctl smooth`: packets of a tracker in, packets of smoothed poses out."""

import math
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
from listening import engine, free_ports
from scipy.spatial.transform import Rotation

from mapctl.skeleton import CANONICAL
from mapctl.streaming.messages import Message
from mapctl.streaming.receiver import read_messages
from mapctl.streaming.relay import PoseRelay
from mapctl.streaming.sender import BONE, BONE_NAMES, OK, ROOT, TIME, FrameAssembler, bundle, encode_frame, pack

ROOT_FOLDER = Path(__file__).resolve().parents[2]
ARM, HAND = CANONICAL.index("leftUpperArm"), CANONICAL.index("rightHand")
DELAY = 0.15
HIPS = np.array([0.1, 0.9, 0.2])


def swing(seconds, amplitude=40.0, hertz=1.0):
    """The angle of the left upper arm, radians."""
    return math.radians(amplitude) * np.sin(2 * math.pi * hertz * np.asarray(seconds))


def tracked(seconds, angle, *, noise_deg=0.0, draw=None):
    """Messages of a pose in which only the left upper arm is turned, about x."""
    turns = np.zeros((21, 3))
    if draw is not None:
        turns = np.radians(noise_deg) * draw.standard_normal((21, 3))
    turns[ARM, 0] += angle
    return encode_frame(CANONICAL, HIPS, Rotation.from_rotvec(turns).as_quat(), seconds)


def received(messages):
    """The same after a network."""
    return [message for packet in pack(messages) for message in read_messages(packet)]


def relayed(pose_at, *, fps=30, seconds=4.0, delay=DELAY, lost=lambda frame: False):
    """Times and poses that come of a tracker's frames, 60 times a second, without sockets and clocks."""
    relay, assembler, frame, found = PoseRelay(delay), FrameAssembler(), 0, []
    for tick in range(round(60 * seconds)):
        now = tick / 60
        while frame / fps <= now:
            if not lost(frame):
                relay.take(received(pose_at(frame / fps)), frame / fps)
            frame += 1
        for packet in relay.frame(now):
            found += [(now, done) for message in read_messages(packet) if (done := assembler.take(message))]
        relay.smoother.smooth()
    times = np.array([each[0] for each in found])
    quats = np.array([each[1].bone_quats_xyzw for each in found])
    return times, Rotation.from_quat(quats.reshape(-1, 4)).as_rotvec().reshape(len(quats), 21, 3), found


def test_poses_are_behind_by_the_delay_and_whole():
    times, turns, found = relayed(lambda seconds: tracked(seconds, swing(seconds)))
    assert times[0] <= DELAY + 2 / 60
    assert np.diff(times).max() < 1.01 / 60, "60 frames a second"
    later = times > 1.0
    errors = {frames: np.abs(turns[later, ARM, 0] - swing(times[later] - frames / 60)).max() for frames in range(5, 14)}
    assert min(errors, key=errors.__getitem__) == round(DELAY * 60)
    assert errors[9] < math.radians(0.5)
    np.testing.assert_allclose(found[-1][1].bone_positions[0], HIPS, atol=1e-5)
    np.testing.assert_allclose(found[-1][1].bone_positions[1:], CANONICAL.offsets[1:], atol=1e-6)


@pytest.mark.parametrize("fps", [30, 60])
def test_noise_is_less_and_fast_motion_stays(fps):
    draw = np.random.default_rng(0)
    times, turns, _ = relayed(
        lambda seconds: tracked(seconds, swing(seconds, hertz=4.0), noise_deg=2.0, draw=draw), fps=fps
    )
    later = times > 2.0
    waves = np.exp(-2j * math.pi * 4.0 * times[later])
    kept = 2 * np.abs((turns[later, ARM, 0] * waves).mean())
    assert math.degrees(kept) == pytest.approx(40.0, rel=0.05)
    still = np.delete(turns[later], ARM, axis=1)
    assert math.degrees(still.std()) < 1.1, "of 2 degrees"


def test_lost_frames_are_bridged():
    _, whole, _ = relayed(lambda seconds: tracked(seconds, swing(seconds)))
    _, turns, _ = relayed(lambda seconds: tracked(seconds, swing(seconds)), lost=lambda frame: frame % 7 == 3)
    assert np.degrees(np.abs(turns - whole))[60:].max() < 1.0


def test_a_silence_comes_to_rest_and_is_left_smoothly():
    times, turns, _ = relayed(
        lambda seconds: tracked(seconds, swing(seconds)), lost=lambda frame: 90 <= frame < 120, seconds=5.0
    )  # from 3 s to 4 s
    speed = np.degrees(np.abs(np.diff(turns[:, ARM, 0]))) * 60
    at = times[1:]
    assert speed[(at > 2.8) & (at < 3.1)].max() > 150, "in motion before"
    assert speed[(at > 3.9) & (at < 4.1)].max() < 5, "at rest"
    assert speed[(at > 3) & (at < 4.6)].max() < 400, "no snap: the arm itself turns at 250 degrees/s"
    back = times > 4.5
    assert np.degrees(np.abs(turns[back, ARM, 0] - swing(times[back] - DELAY))).max() < 2.0


def test_a_spike_does_not_pass():
    draw = np.random.default_rng(1)

    def pose(seconds):
        messages = tracked(seconds, swing(seconds), noise_deg=1.0, draw=draw)
        if round(30 * seconds) in (70, 101):
            at = next(k for k, each in enumerate(messages) if each.arguments[0] == BONE_NAMES[HAND])
            messages[at] = Message(BONE, (*messages[at].arguments[:4], 0.0, 0.6, 0.0, 0.8))
        return messages

    times, turns, _ = relayed(pose)
    assert np.degrees(np.abs(turns[times > 1.0, HAND])).max() < 4.0


def test_what_is_not_of_the_body_passes_at_once_and_unchanged():
    relay = PoseRelay(DELAY)
    others = [
        Message("/VMC/Ext/Blend/Val", ("Joy", 0.5)),
        Message("/VMC/Ext/Blend/Apply"),
        Message(BONE, ("LeftIndexProximal", *[0.0] * 6, 1.0)),
        Message("/VMC/Ext/Cam", ("Camera", *[0.0] * 6, 1.0, 40.0)),
    ]
    sent = received([*others, Message(OK, (1, 3, 1, 1)), Message(TIME, (0.0,))])
    assert [each for packet in relay.take(sent, 0.0) for each in read_messages(packet)] == others
    packets: list[bytes] = []
    for tick in range(60):
        relay.take(received(tracked(tick / 30, 0.0)[:-2]), tick / 30)  # without OK and time
        packets = relay.frame(tick / 30)
        relay.smoother.smooth()
    found = [message for packet in packets for message in read_messages(packet)]
    assert [message.arguments for message in found if message.address == OK] == [(1, 3, 1, 1)]


def test_other_bones_and_missing_ones_do_not_matter():
    """An upper body alone, in messages of their own, with a root as version 2.1 has it."""
    relay, names = PoseRelay(DELAY), ("Head", "UpperChest", "LeftUpperArm")
    packets: list[bytes] = []
    root = Message(ROOT, ("root", *[0.0] * 6, 1.0, *[1.0] * 3, *[0.0] * 3))
    for tick in range(60):
        for message in [root, *(Message(BONE, (name, *[0.0] * 6, 1.0)) for name in names)]:
            assert relay.take([message], tick / 30) == []
        packets = relay.frame(tick / 30)
        relay.smoother.smooth()
    found = [message for packet in packets for message in read_messages(packet)]
    assert {message.arguments[0] for message in found if message.address == BONE} == set(names)
    assert [message for message in found if message.address == ROOT] == [root]


@pytest.mark.parametrize(
    "arguments",
    [
        (),
        ("Hips",),
        ("Hips", *[math.nan] * 7),
        ("Hips", *[0.0] * 7),
        ("Hips", 1e30, *[0.0] * 5, 1.0),
        ("Hips", *["x"] * 7),
        (3, *[0.0] * 6, 1.0),
    ],
)
def test_malformed_bones_change_nothing(arguments):
    wrong = Message(BONE, arguments)
    times, turns, _ = relayed(lambda seconds: [*tracked(seconds, 0.1)[:-1], wrong, *tracked(0, 0)[-1:]], seconds=2.0)
    np.testing.assert_allclose(turns[times > 1.0, ARM, 0], 0.1, atol=1e-6)


def test_packets_are_joined_up_to_their_limit():
    packed = [bytes([65 + k]) * 500 for k in range(4)]
    joined = bundle(packed)
    assert list(map(len, joined)) == [16 + 2 * 504] * 2
    assert joined[0].endswith(packed[1])
    assert bundle([]) == []


def test_the_command_relays_and_ends(tmp_path):
    """As a user has it: packets and nonsense to one port, poses and blend shapes from another; Ctrl-C ends."""
    ports = free_ports(2)
    words = [sys.executable, "-m", "mapctl", "smooth", "--listen", str(ports), "--stream", f":{ports + 1}"]
    environment = os.environ | {"PYTHONPATH": str(ROOT_FOLDER), "OMP_NUM_THREADS": "1"}
    with engine(ports + 1) as viewer, closing(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) as tracker:
        running = subprocess.Popen(words, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        try:
            assert f"poses of 127.0.0.1:{ports} go to 127.0.0.1:{ports + 1} (VMC)" in running.stdout.readline()
            end, frame = time.perf_counter() + 60, 0
            while len(viewer.frames) < 30 and time.perf_counter() < end:
                for packet in [*pack(tracked(frame / 30, 0.3)), os.urandom(80), b"#bundle\0"]:
                    tracker.sendto(packet, ("127.0.0.1", ports))
                frame += 1
                time.sleep(1 / 30)
        finally:
            running.send_signal(signal.SIGINT)
            out, fault = running.communicate(timeout=30)
    assert (running.returncode, fault) == (0, "")
    assert "packets were not understood" in out
    assert len(viewer.frames) >= 30
    turns = Rotation.from_quat(viewer.frames[-1].bone_quats_xyzw).as_rotvec()
    assert turns[ARM, 0] == pytest.approx(0.3, abs=1e-3)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("--stream", "host"), "--stream must be HOST:PORT"),
        (("--stream", "39540", "--delay", "3"), "--delay must be 0.05 to 1 seconds, got 3"),
        (("--stream", "39540", "--delay", "nan"), "--delay must be 0.05 to 1 seconds"),
        (("--stream", "localhost:39540", "--listen", "0.0.0.0:39540"), "is where --stream sends poses to"),
    ],
)
def test_what_cannot_be_is_one_line(fails, words, said):
    assert said in fails("smooth", *words)


def test_a_taken_port_is_one_line(fails):
    with closing(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) as held:
        held.bind(("127.0.0.1", 0))
        port = held.getsockname()[1]
        assert f"port {port} of 127.0.0.1 is in use" in fails("smooth", "--listen", port, "--stream", "39541")
