"""What arrives from other programs: messages, nonsense and floods."""

import random
import socket
import struct
import time
from contextlib import closing

import pytest
from pythonosc.udp_client import SimpleUDPClient

from mapctl.errors import RequestError
from mapctl.streaming.messages import Endpoint, Message
from mapctl.streaming.receiver import MAX_DATAGRAM_BYTES, OscReceiver


def free_port() -> int:
    with closing(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


@pytest.fixture
def receiver():
    with closing(OscReceiver(Endpoint("127.0.0.1", free_port()))) as made:
        yield made


@pytest.fixture
def sender(receiver):
    """Sends bytes to the receiver."""
    with closing(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) as made:
        yield lambda packet: made.sendto(packet, ("127.0.0.1", receiver.endpoint.port))


def test_messages_arrive_in_order_and_nothing_waits(receiver):
    assert receiver.poll() == []
    with SimpleUDPClient("127.0.0.1", receiver.endpoint.port) as client:
        client.send_message("/mapctl/speed", 1.5)
        client.send_message("/mapctl/style", "old")
        client.send_message("/mapctl/stop", [])
    assert receiver.poll() == [
        Message("/mapctl/speed", (1.5,)),
        Message("/mapctl/style", ("old",)),
        Message("/mapctl/stop"),
    ]
    assert receiver.poll() == []


def test_a_port_that_is_taken_is_said(receiver):
    with pytest.raises(RequestError, match=rf"--listen: port {receiver.endpoint.port} of 127\.0\.0\.1 is in use"):
        OscReceiver(receiver.endpoint)


def nonsense(count: int) -> list[bytes]:
    """Packets of every kind of damage."""
    draw = random.Random(7)
    good = b"/mapctl/speed\0\0\0,f\0\0" + struct.pack(">f", 1.0)
    bundle = b"#bundle\0" + struct.pack(">QI", 1, len(good)) + good
    made = [b"", b"/", b"/\0\0\0", b"#bundle\0", b"\xff" * 30, good[:-2], b"/a\0\0,zqx\0\0\0\0", b"/a\0\0,[[[\0\0\0\0"]
    made += [b"#bundle\0" + struct.pack(">Qi", 1, size) for size in (-1, -(2**31), 2**31 - 1, 0)]
    deep = good
    for _ in range(150):
        deep = b"#bundle\0" + struct.pack(">QI", 1, len(deep)) + deep
    made += [deep, b"/a\0\0,b\0\0" + struct.pack(">i", -5), b"/\xc3\x28\0,s\0\0\xc3\x28\0\0"]
    for _ in range(count):
        packet = bytearray(draw.choice((good, bundle)))
        for _ in range(draw.randint(1, 8)):
            packet[draw.randrange(len(packet))] = draw.randrange(256)
        made += [bytes(packet), draw.randbytes(draw.randrange(200)), bytes(packet[: draw.randrange(len(packet))])]
    return made


def test_nonsense_is_counted_and_changes_nothing(receiver, sender, capfd):
    """Whatever it is read as is checked again as an order; here nothing may be raised, or printed."""
    for k, packet in enumerate(nonsense(600)):
        sender(packet)
        if k % 50 == 0:
            receiver.poll()
    receiver.poll()
    assert receiver.dropped > 500
    assert receiver.fault.isprintable()
    sender(b"/mapctl/stop\0\0\0\0,\0\0\0")
    assert receiver.poll() == [Message("/mapctl/stop")]
    assert capfd.readouterr() == ("", "")


def test_long_packets_are_not_read(receiver, sender):
    sender(b"/a\0\0,i\0\0" + bytes(MAX_DATAGRAM_BYTES))
    assert receiver.poll() == []
    assert receiver.dropped == 1


def test_of_a_flood_the_newest_count_and_a_look_is_short(receiver, sender):
    receiver._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 2**22)
    costly = b"/a\0\0," + b"i" * 1003 + b"\0" * 8 + bytes(3000)
    for _ in range(200):
        sender(costly)
    sender(b"/mapctl/stop\0\0\0\0,\0\0\0")
    began = time.thread_time()  # a wall clock would count other processes, too
    found = receiver.poll()
    assert time.thread_time() - began < 0.25
    assert found[-1] == Message("/mapctl/stop")
