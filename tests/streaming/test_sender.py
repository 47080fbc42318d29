"""The stream itself: each frame at its time, to its character's port."""

import socket
import time
from contextlib import ExitStack

import numpy as np
import pytest
from helpers import walk

from mapctl.runtime.live_protocol import FrameChunk
from mapctl.skeleton import CANONICAL
from mapctl.streaming.messages import Endpoint
from mapctl.streaming.receiver import read_messages
from mapctl.streaming.sender import FrameAssembler, PoseStream, VmcFrame

MOTION = walk(30)
ROOT, QUATS = MOTION.root_position.numpy(), MOTION.local_quat_xyzw.numpy()
NOTHING = np.zeros((30, 2))
ALLOWED = 1.0  # seconds by which a busy machine may be late; how late a quiet one is, slow tests say


def chunk(due: float, seconds: float, first: int, stop: int) -> FrameChunk:
    """Frames of the motion."""
    part, nothing = slice(first, stop), NOTHING[first:stop]
    arrays = ROOT[part], QUATS[part], nothing, np.zeros((0, 21, 3))
    return FrameChunk(due, seconds, *arrays, (0.0, 0.0), 0.0, 0.0, 0.0, nothing, np.zeros((0, 3)))


def open_ports(count: int, stack: ExitStack) -> list[socket.socket]:
    """Sockets at ports that follow each other."""
    for base in range(42000, 60000, 50):
        result = [stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) for _ in range(count)]
        try:
            for k, one in enumerate(result):
                one.bind(("127.0.0.1", base + k))
                one.settimeout(5.0)
        except OSError:
            continue
        return result
    raise AssertionError("no free ports")


@pytest.fixture
def ports():
    with ExitStack() as stack:
        yield open_ports(2, stack)


@pytest.fixture
def stream(ports):
    """To both ports, without delay; whoever uses it closes it."""
    result = PoseStream(Endpoint("127.0.0.1", ports[0].getsockname()[1]), [CANONICAL] * 2, delay=0.0)
    yield result
    if result._process.is_alive():
        result.close()


def received(port: socket.socket, count: int) -> list[tuple[float, VmcFrame]]:
    """So many frames with the time at which each was whole."""
    assembler, found = FrameAssembler(), []
    while len(found) < count:
        packet, now = port.recv(65536), time.perf_counter()
        found += [(now, frame) for message in read_messages(packet) if (frame := assembler.take(message)) is not None]
    return found


def start(stream: PoseStream) -> float:
    """A moment at which its process has surely begun."""
    return time.perf_counter() + 1.0


@pytest.mark.slow
def test_frames_come_when_they_are_due_and_are_those_that_were_put(stream, ports):
    due = start(stream)
    for first in (3, 0, 6):  # in whatever order they are put
        stream.put(0, chunk(due + first / 30, first / 30, first, first + 3))
    found = received(ports[0], 9)
    for k, (at, frame) in enumerate(found):
        assert -0.001 < at - (due + k / 30) < ALLOWED
        assert frame.seconds == pytest.approx(k / 30, abs=1e-6)
        np.testing.assert_allclose(frame.joint_positions(), MOTION.joint_positions()[k], atol=1e-5)
    stream.close()
    sent = stream.statistics
    assert (sent.frames_sent, sent.not_sent, sent.fault) == (9, 0, "")


@pytest.mark.slow
def test_each_character_has_its_port_and_is_forgotten_alone(stream, ports):
    due = start(stream)
    stream.put(0, chunk(due, 0.0, 0, 3))
    stream.put(1, chunk(due, 0.0, 3, 6))
    stream.forget(0)
    stream.put(0, chunk(due, 7.0, 9, 10))
    ((_, only),) = received(ports[0], 1)
    assert only.seconds == 7.0
    others = received(ports[1], 3)
    np.testing.assert_allclose(others[0][1].joint_positions(), MOTION.joint_positions()[3], atol=1e-5)
    stream.close()
    assert stream.statistics.frames_sent == 4


def test_late_frames_are_counted_and_sent(stream, ports):
    now = start(stream)
    stream.put(0, chunk(now - 5.0, 0.0, 0, 3))
    assert len(received(ports[0], 3)) == 3
    stream.close()
    assert stream.statistics.late == 3
    assert stream.statistics.largest_lateness_ms > 3000


@pytest.mark.slow
def test_closing_sends_what_waits(stream, ports):
    due = start(stream)
    stream.put(0, chunk(due, 0.0, 0, 9))
    stream.close()
    assert len(received(ports[0], 9)) == 9
    assert time.perf_counter() > due + 8 / 30
    assert not stream._process.is_alive()


def test_a_process_that_has_ended_ends_nothing(stream):
    stream._process.kill()
    stream._process.join()
    for _ in range(100):
        stream.put(0, chunk(time.perf_counter(), 0.0, 0, 3))
    stream.close()
    assert stream.statistics.frames_sent == 0
