"""Where packets go: on this machine unless a host is written."""

import pytest

from mapctl.errors import RequestError
from mapctl.streaming.messages import Endpoint


@pytest.mark.parametrize(
    ("text", "host", "port"),
    [
        ("39539", "127.0.0.1", 39539),
        (":39539", "127.0.0.1", 39539),
        ("127.0.0.1:1", "127.0.0.1", 1),
        ("192.168.1.20:65535", "192.168.1.20", 65535),
        ("studio.local:39540", "studio.local", 39540),
        ("[::1]:39539", "::1", 39539),
        ("0.0.0.0:39540", "0.0.0.0", 39540),
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
