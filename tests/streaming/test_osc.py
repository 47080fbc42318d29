"""OSC from other programs: where packets go, messages, nonsense and floods, and which of them are orders."""

import math
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
from scenes.live.remote import Order, keep_latest, read_order

GROUPS = ("gait", "style")


def read(address: str, *arguments: object, characters: int = 3) -> Order:
    return read_order(Message(address, arguments), characters=characters, groups=GROUPS)


@pytest.mark.parametrize(
    ("address", "arguments", "order"),
    [
        ("/mapctl/speed", (1.5,), Order(0, "speed", (1.5,))),
        ("/mapctl/3/heading", (90.0,), Order(2, "heading", (90.0,))),
        ("/mapctl/reset", (), Order(0, "reset")),
        ("/mapctl/style", ("old",), Order(0, "style", ("old",))),
        ("/mapctl/2/hand/left", (0.1, 1.2, 3.0), Order(1, "hand/left", (0.1, 1.2, 3.0))),
        ("/mapctl/goto", (1.0, 2.0, 1.5), Order(0, "goto", (1.0, 2.0, 1.5))),
    ],
)
def test_orders_are_read(address, arguments, order):
    assert read(address, *arguments) == order


@pytest.mark.parametrize(
    ("address", "arguments", "said"),
    [
        ("/mapctl/sped", (1.0,), "/mapctl/sped is no order; there are /mapctl/ and speed, .*gait, style"),
        ("/mapctl/4/speed", (1.0,), "no character 4"),
        ("/mapctl/speed", (), "takes 1 number, not 0"),
        ("/mapctl/speed", (math.nan,), "takes finite numbers"),
        ("/mapctl/speed", ("1.5",), "takes finite numbers"),
        ("/mapctl/hand/left", (1.0, 2.0), "takes no or 3 numbers, not 2"),
        ("/mapctl/goto", (1.0,), "takes 2 or 3 or 4 numbers, not 1"),
        ("/mapctl/style", (3.0,), "takes one word"),
    ],
)
def test_others_are_refused_with_what_is_allowed(address, arguments, said):
    with pytest.raises(RequestError, match=said):
        read(address, *arguments)


def test_the_last_order_of_a_kind_and_character_counts():
    orders = [
        read("/mapctl/speed", 1.0),
        read("/mapctl/2/speed", 3.0),
        read("/mapctl/reset"),
        read("/mapctl/speed", 2.0),
    ]
    assert keep_latest(orders) == [orders[1], orders[2], orders[3]]


@pytest.mark.parametrize(
    ("text", "host", "port"),
    [
        ("39539", "127.0.0.1", 39539),
        (":39539", "127.0.0.1", 39539),
        ("192.168.1.20:65535", "192.168.1.20", 65535),
        ("studio.local:39540", "studio.local", 39540),
        ("[::1]:39539", "::1", 39539),
    ],
)
def test_a_host_must_be_written_to_be_another_than_this_machine(text, host, port):
    assert Endpoint.parse(text, option="--stream") == Endpoint(host, port)


@pytest.mark.parametrize(
    "text", ["", "host", "host:", ":0", ":65536", "a:b:1", "::1:5", "1.2.3.4:-5", "x:12e3", "[::1]"]
)
def test_anything_else_is_refused(text):
    with pytest.raises(RequestError, match=r"--listen must be HOST:PORT.*65535"):
        Endpoint.parse(text, option="--listen")


def test_ports_of_further_characters():
    assert Endpoint("a", 39539).offset(2, option="--stream") == Endpoint("a", 39541)
    with pytest.raises(RequestError, match="character 3 would be at port 65536"):
        Endpoint("a", 65534).offset(2, option="--stream")


def free_port() -> int:
    with closing(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


@pytest.fixture
def receiver():
    with closing(OscReceiver(Endpoint("127.0.0.1", free_port()))) as result:
        yield result


@pytest.fixture
def sender(receiver):
    """Sends bytes to the receiver."""
    with closing(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) as result:
        yield lambda packet: result.sendto(packet, ("127.0.0.1", receiver.endpoint.port))


def test_messages_arrive_in_order_and_nothing_waits(receiver):
    assert receiver.poll() == []
    with SimpleUDPClient("127.0.0.1", receiver.endpoint.port) as client:
        client.send_message("/mapctl/speed", 1.5)
        client.send_message("/mapctl/style", "old")
        client.send_message("/mapctl/reset", [])
    assert receiver.poll() == [
        Message("/mapctl/speed", (1.5,)),
        Message("/mapctl/style", ("old",)),
        Message("/mapctl/reset"),
    ]
    assert receiver.poll() == []


def test_a_taken_port_is_reported(receiver):
    with pytest.raises(RequestError, match=rf"--listen: port {receiver.endpoint.port} of 127\.0\.0\.1 is in use"):
        OscReceiver(receiver.endpoint)


def nonsense(count: int) -> list[bytes]:
    """Packets of every kind of damage."""
    draw = random.Random(7)
    good = b"/mapctl/speed\0\0\0,f\0\0" + struct.pack(">f", 1.0)
    bundle = b"#bundle\0" + struct.pack(">QI", 1, len(good)) + good
    result = [
        b"",
        b"/",
        b"/\0\0\0",
        b"#bundle\0",
        b"\xff" * 30,
        good[:-2],
        b"/a\0\0,zqx\0\0\0\0",
        b"/a\0\0,[[[\0\0\0\0",
    ]
    result += [b"#bundle\0" + struct.pack(">Qi", 1, size) for size in (-1, -(2**31), 2**31 - 1, 0)]
    deep = good
    for _ in range(150):
        deep = b"#bundle\0" + struct.pack(">QI", 1, len(deep)) + deep
    result += [deep, b"/a\0\0,b\0\0" + struct.pack(">i", -5), b"/\xc3\x28\0,s\0\0\xc3\x28\0\0"]
    for _ in range(count):
        packet = bytearray(draw.choice((good, bundle)))
        for _ in range(draw.randint(1, 8)):
            packet[draw.randrange(len(packet))] = draw.randrange(256)
        result += [bytes(packet), draw.randbytes(draw.randrange(200)), bytes(packet[: draw.randrange(len(packet))])]
    return result


def test_nonsense_is_counted_and_changes_nothing(receiver, sender, capfd):
    """Whatever it is read as is checked again as an order; here nothing may be raised, or printed."""
    for k, packet in enumerate(nonsense(600)):
        sender(packet)
        if k % 50 == 0:
            receiver.poll()
    receiver.poll()
    assert receiver.dropped > 500
    assert receiver.fault.isprintable()
    sender(b"/mapctl/reset\0\0\0,\0\0\0")
    assert receiver.poll() == [Message("/mapctl/reset")]
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
    sender(b"/mapctl/reset\0\0\0,\0\0\0")
    began = time.thread_time()  # a wall clock would count other processes, too
    found = receiver.poll()
    assert time.thread_time() - began < 0.25
    assert found[-1] == Message("/mapctl/reset")
