"""The page: requests of its own origin only, messages of its script, keys and sticks."""

import json
import math
import urllib.error
import urllib.request

import pytest
import viser
from websockets.asyncio import server as websockets_server
from websockets.datastructures import Headers
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect

from mapctl.errors import RequestError
from scenes.live.inputs import ACTIONS, HELP, KEYS, Driving, find_direction, read_position
from scenes.live.page import PageChannel, PageState, is_own_page, open_server, parse_state

OWN = {"Host": "127.0.0.1:8080", "Origin": "http://127.0.0.1:8080", "Upgrade": "websocket"}


@pytest.mark.parametrize(
    ("changes", "may"),
    [
        ({}, True),
        ({"Origin": "http://LOCALHOST:8080", "Host": "localhost:8080"}, True),
        ({"Origin": None, "Upgrade": None}, True),
        ({"Origin": None}, False),
        ({"Origin": "http://example.org"}, False),
        ({"Origin": "http://127.0.0.1:8081"}, False),
        ({"Origin": "https://127.0.0.1:8080"}, False),
        ({"Origin": "http://127.0.0.1:8080.example.org"}, False),
        ({"Origin": "null"}, False),
        ({"Host": "example.org:8080"}, False),
        ({"Host": "example.org:8080", "Origin": None, "Upgrade": None}, False),
        ({"Host": None}, False),
    ],
    ids=str,
)
def test_only_pages_of_this_server_may_connect(changes, may):
    headers = Headers({name: value for name, value in (OWN | changes).items() if value is not None})
    assert is_own_page(headers, 8080) is may


@pytest.fixture(scope="module")
def channel():
    return PageChannel(KEYS, HELP)


@pytest.fixture(scope="module")
def server(channel):
    result = open_server(8490, channel)
    yield result
    result.stop()


def test_a_foreign_page_gets_neither_a_socket_nor_the_page(server):
    assert websockets_server.serve.__module__ == "websockets.asyncio.server", "the library is as it was"
    for path in ("", "/mapctl/page"):
        for origin in ("http://example.org", "null", None):
            with pytest.raises(InvalidStatus, match="403"):
                connect(f"ws://127.0.0.1:{server.get_port()}{path}", origin=origin)
    page = f"http://127.0.0.1:{server.get_port()}/"
    for headers in ({"Origin": "http://example.org"}, {"Host": "example.org"}):
        with pytest.raises(urllib.error.HTTPError, match="403"):
            urllib.request.urlopen(urllib.request.Request(page, headers=headers))


def test_the_page_has_the_script_and_may_not_be_framed(server):
    with urllib.request.urlopen(f"http://127.0.0.1:{server.get_port()}/") as answer:
        page = answer.read().decode()
        assert answer.headers["X-Frame-Options"] == "DENY"
        assert answer.headers["Content-Security-Policy"] == "frame-ancestors 'none'"
    assert page.index("<script data-keys='") < page.index("<title")
    assert set(page.split("data-keys='")[1].split("'")[0].split()) == set(KEYS)
    own = f"http://localhost:{server.get_port()}"
    with connect(own.replace("http", "ws"), origin=own, subprotocols=[f"viser-v{viser.__version__}"]) as socket:
        assert isinstance(socket.recv(timeout=5), bytes)


def test_states_arrive_and_nonsense_is_ignored(server, channel):
    own = f"http://127.0.0.1:{server.get_port()}"
    channel.poll()
    with connect(f"{own.replace('http', 'ws')}/mapctl/page", origin=own) as socket:
        for text in ('{"keys": ["KeyW"]}', "{", "nonsense", '{"keys": [], "viewer": 3}'):
            socket.send(text)
    found = []
    while not found or found[-1][1] is not None:
        found += channel.poll()
    assert [state for _, state in found] == [PageState(keys={"KeyW"}), PageState(viewer=3), None]


@pytest.mark.parametrize(
    "text",
    [
        "[]",
        "null",
        '{"keys": "KeyW"}',
        '{"keys": [["KeyW"]]}',
        json.dumps({"keys": [f"Key{k}" for k in range(17)]}),
        '{"stick": [1e9, 0, 0]}',
        '{"stick": [NaN, 0, 0]}',
        '{"stick": {}}',
        '{"viewer": -1}',
        '{"other": 1}',
        "[" * 1900,
        "x" * 5000,
        b"\xff",
        None,
    ],
)
def test_what_is_no_state_is_none(text):
    assert parse_state(text) is None


class Deck:
    """Notes what it is asked, angles in degrees; the camera looks along +X."""

    def __init__(self):
        self.heard: list[tuple] = []
        self._facings, self.locked = iter((70.0, 75.0)), None
        self.chosen, self.view, self.fastest = self, self, 3.8
        self.driving = Driving(self)

    facing = property(lambda self: math.radians(next(self._facings)))

    def steer(self, speed, *angles):
        self.heard.append(("steer", speed, *(angle if angle is None else math.degrees(angle) for angle in angles)))

    def act(self, action):
        self.heard.append(("act", action))

    def find_heading(self, direction, viewer):
        return math.pi / 2 - math.atan2(*direction)

    def find_lock(self):
        return self.locked and math.radians(self.locked)

    def hold(self, *codes: str, page: int = 0, at: float | None = None) -> None:
        self.driving.update(page, PageState(keys=frozenset(codes)))
        if at is not None:
            self.driving.step(at)


@pytest.fixture
def deck() -> Deck:
    return Deck()


def test_a_held_key_walks_as_seen_from_the_camera_and_releasing_it_stands(deck):
    for k in range(30):
        deck.hold("KeyW", at=k / 60)
    assert deck.heard == [("steer", 1.2, 90.0, None)], "the same is not sent again"
    deck.hold("KeyW", "ShiftLeft", "KeyA", at=1.0)
    assert deck.heard[-1] == ("steer", pytest.approx(2.85), pytest.approx(135.0), None)
    deck.hold(at=1.01)
    deck.driving.step(1.02)
    assert deck.heard[2:] == [("steer", 0.0, None, None)]


def test_the_first_page_drives_until_it_releases_or_goes_away(deck):
    deck.hold("KeyW", at=0.0)
    deck.hold("KeyS", page=1, at=0.2)
    assert len(deck.heard) == 1
    deck.hold(at=0.4)
    assert deck.heard[-1] == ("steer", 1.2, pytest.approx(-90.0), None)
    deck.driving.update(1, None)
    deck.driving.step(0.5)
    assert deck.heard[-1] == ("steer", 0.0, None, None)


def test_single_keys_act_once(deck):
    deck.hold("KeyX", at=0.0)
    deck.hold("KeyX", "KeyP", at=5.0)
    assert deck.heard == [("act", "KeyX"), ("act", "KeyP")]


def test_a_stick_walks_with_its_push_a_trigger_runs_and_an_unplugged_gamepad_stands(deck):
    def push(at: float, right: float, down: float, trigger: float = 0.0) -> list[tuple]:
        deck.driving.update(0, PageState(stick=(right, down, trigger)))
        deck.driving.step(at)
        return deck.heard[-1:]

    assert push(0.0, 0.1, -0.1) == [], "sticks never rest at zero"
    assert push(0.1, 0.0, -1.0) == [("steer", 1.2, pytest.approx(90.0), None)]
    assert push(0.3, 0.0, -1.0, 1.0) == [("steer", pytest.approx(2.85), pytest.approx(90.0), None)]
    assert push(0.5, 0.565, 0.0) == [("steer", pytest.approx(0.6), pytest.approx(0.0), None)]
    deck.driving.update(0, PageState())
    deck.driving.step(0.7)
    assert deck.heard[-1] == ("steer", 0.0, None, None)


def test_strafing_keeps_the_facing_and_so_does_standing_after_it(deck):
    deck.hold("KeyQ", at=0.0)
    deck.hold("KeyQ", at=0.2)
    deck.hold("KeyE", "KeyW", at=0.4)
    deck.hold(at=0.6)
    deck.hold("KeyA", at=0.8)
    assert deck.heard == [
        ("steer", 1.2, pytest.approx(180.0), pytest.approx(70.0)),
        ("steer", 1.2, pytest.approx(45.0), pytest.approx(70.0)),
        ("steer", 0.0, None, pytest.approx(70.0)),
        ("steer", 1.2, pytest.approx(180.0), None),
    ]


def test_a_locked_facing_holds_in_all_directions_and_the_right_stick_goes_before_it(deck):
    deck.locked = -30.0
    deck.hold("KeyW", at=0.0)
    deck.locked = -35.0
    deck.driving.step(0.2)
    assert deck.heard == [("steer", 1.2, 90.0, pytest.approx(-30.0)), ("steer", 1.2, 90.0, pytest.approx(-35.0))]
    deck.driving.update(0, PageState(keys={"KeyW"}, aim=(1.0, 0.0)))
    deck.driving.step(0.4)
    assert deck.heard[-1] == ("steer", 1.2, 90.0, pytest.approx(0.0))
    deck.driving.update(0, PageState(aim=(0.0, 1.0)))
    deck.driving.step(0.6)
    assert deck.heard[-1] == ("steer", 0.0, None, pytest.approx(-90.0)), "it turns where it stands"


def test_directions_add_up():
    assert find_direction({"KeyW", "ArrowUp", "KeyD"}) == pytest.approx((0.5**0.5, 0.5**0.5))
    assert find_direction({"KeyW", "KeyS"}) is None
    text = " ".join(key for key, _ in HELP)
    assert all(code.removeprefix("Key") in text for code in ACTIONS)


@pytest.mark.parametrize("value", ["x", (1, 2), (math.nan, 0, 0), (0, 1e9, 0), None])
def test_points_are_finite_and_near(value):
    with pytest.raises(RequestError, match="position"):
        read_position(value)
    assert read_position([1, 2, 3.5]) == (1.0, 2.0, 3.5)
