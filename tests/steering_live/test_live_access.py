"""Who may speak to the live viewer's server, and what nonsense ends: at most the connection of whoever sent it."""

import asyncio
import contextlib
import logging
import time
import urllib.error
import urllib.request
from collections.abc import Callable

import msgspec
import pytest
import viser
import websockets.asyncio.server
from websockets.datastructures import Headers
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.protocol import State
from websockets.sync.client import ClientConnection, connect

from scenes.live.access import ServerErrorReporter, format_error, is_own_page, restrict_to_own_pages

OWN = {"Host": "127.0.0.1:8080", "Origin": "http://127.0.0.1:8080", "Upgrade": "websocket"}


@pytest.mark.parametrize(
    ("changes", "may"),
    [
        ({}, True),
        ({"Origin": "http://localhost:8080", "Host": "localhost:8080"}, True),
        ({"Origin": "http://LOCALHOST:8080"}, True),
        ({"Origin": None, "Upgrade": None}, True),
        ({"Origin": None}, False),
        ({"Origin": "http://example.org"}, False),
        ({"Origin": "http://127.0.0.1:8081"}, False),
        ({"Origin": "https://127.0.0.1:8080"}, False),
        ({"Origin": "http://127.0.0.1:8080.example.org"}, False),
        ({"Origin": "null"}, False),
        ({"Origin": ""}, False),
        ({"Origin": "http://example.org", "Upgrade": None}, False),
        ({"Host": "example.org:8080"}, False),
        ({"Host": "example.org:8080", "Origin": None, "Upgrade": None}, False),
        ({"Host": "127.0.0.1"}, False),
        ({"Host": None}, False),
    ],
)
def test_only_pages_of_this_server_may_come(changes, may):
    headers = Headers({name: value for name, value in (OWN | changes).items() if value is not None})
    assert is_own_page(headers, 8080) is may


def test_two_origins_are_none():
    headers = Headers(OWN)
    headers["Origin"] = "http://example.org"
    assert not is_own_page(headers, 8080)


@pytest.fixture(scope="module")
def told() -> list[str]:
    return []


@pytest.fixture(scope="module")
def server(told):
    with restrict_to_own_pages():
        made = viser.ViserServer(host="127.0.0.1", port=8490, verbose=False)
    quiet = ServerErrorReporter(made.get_event_loop(), told.append)
    yield made
    quiet.close()
    made.stop()


def opened(server: viser.ViserServer, origin: str | None) -> contextlib.AbstractContextManager[ClientConnection]:
    port = server.get_port()
    return connect(f"ws://127.0.0.1:{port}", origin=origin, subprotocols=[f"viser-v{viser.__version__}"])


def update(control: viser.GuiInputHandle, value: object) -> bytes:
    """What a page sends when somebody moves a control."""
    return msgspec.msgpack.encode({"type": "GuiUpdateMessage", "uuid": control._impl.uuid, "updates": {"value": value}})


def comes_true(what: Callable[[], bool]) -> bool:
    """Within five seconds."""
    until = time.monotonic() + 5
    while not what() and time.monotonic() < until:
        time.sleep(0.01)
    return what()


def test_the_library_is_as_it_was(server):
    assert websockets.asyncio.server.serve.__module__ == "websockets.asyncio.server"


def test_a_foreign_page_gets_neither_a_socket_nor_the_page(server):
    for origin in ("http://example.org", "http://127.0.0.1:1", "null", None):
        with pytest.raises(InvalidStatus, match="403"), opened(server, origin):
            pass
    page = f"http://127.0.0.1:{server.get_port()}/"
    for headers in ({"Origin": "http://example.org"}, {"Host": "example.org"}):
        with pytest.raises(urllib.error.HTTPError, match="403"):
            urllib.request.urlopen(urllib.request.Request(page, headers=headers))


def test_the_page_comes_and_may_not_be_framed(server):
    with urllib.request.urlopen(f"http://127.0.0.1:{server.get_port()}/") as answer:
        assert b"<html" in answer.read().lower()
        assert answer.headers["X-Frame-Options"] == "DENY"
        assert answer.headers["Content-Security-Policy"] == "frame-ancestors 'none'"


@pytest.mark.parametrize("host", ["127.0.0.1", "localhost"])
def test_the_own_page_gets_a_socket(server, host):
    with opened(server, f"http://{host}:{server.get_port()}") as socket:
        assert isinstance(socket.recv(timeout=5), bytes)


@pytest.mark.parametrize("nonsense", ["text", b"", b"\xff\xff", msgspec.msgpack.encode({"type": "NoSuchMessage"})])
def test_nonsense_ends_one_connection_at_most_and_is_said_in_a_line(server, told, capfd, nonsense):
    told.clear()
    slider = server.gui.add_slider("x", 0, 10, 1, 3)
    own = f"http://127.0.0.1:{server.get_port()}"
    with opened(server, own) as other, opened(server, own) as socket:
        socket.send(nonsense)
        with contextlib.suppress(ConnectionClosed):
            while socket.recv(timeout=5):
                pass
        assert socket.state is State.CLOSED
        other.send(update(slider, 7))
        assert comes_true(lambda: slider.value == 7)
    assert len(told) == 1
    assert "\n" not in told[0]
    assert "Traceback" not in "".join(capfd.readouterr())


def test_a_value_that_a_control_cannot_have_is_said_and_the_control_stays(server, told, capfd):
    told.clear()
    slider = server.gui.add_slider("x", 0, 10, 1, 3)
    with opened(server, f"http://127.0.0.1:{server.get_port()}") as socket:
        socket.send(update(slider, "many"))
        socket.send(update(slider, 7))
        assert comes_true(lambda: slider.value == 7)
    [line] = told
    assert line.startswith("a browser sent what cannot be understood: ValueError: invalid literal")
    assert "Traceback" not in "".join(capfd.readouterr())


def test_an_error_is_told_in_one_short_line():
    assert format_error(ValueError("two\n  lines")) == "ValueError: two lines"
    assert format_error(KeyError()) == "KeyError"
    assert format_error("plain") == "plain"
    assert len(format_error(ValueError("x" * 999))) == 200


def test_who_goes_away_is_not_spoken_of(told):
    told.clear()
    quiet = ServerErrorReporter(asyncio.new_event_loop(), told.append)
    record = logging.LogRecord("websockets.server", logging.ERROR, "", 0, "", (), None)
    for error in (ConnectionResetError(), EOFError()):
        record.exc_info = (type(error), error, None)
        assert not quiet._filter_record(record)
    record.exc_info = None
    assert quiet._filter_record(record)
    quiet.close()
    assert told == []
