"""The page: requests of its own origin only, messages of its script, keys and sticks, and limits of inputs."""

import json
import math
import urllib.error
import urllib.request

import pytest
import viser
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from websockets.asyncio import server as websockets_server
from websockets.datastructures import Headers
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect

from mapctl.intent.steering import Command
from scenes.live.inputs import (
    ACTIONS,
    HELP,
    KEYS,
    UNCONDITIONED,
    Driving,
    InputLimits,
    SteeringInputs,
    find_direction,
    parse_point,
)
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
    """Notes what it is asked; the camera looks along +X."""

    def __init__(self):
        self.heard: list[tuple] = []
        self._facings, self.locked = iter((70.0, 75.0)), None
        self.chosen, self.view, self.limits = self, self, InputLimits(3.8, {})
        self.driving = Driving(self)

    facing = property(lambda self: math.radians(next(self._facings)))

    def steer(self, *asked):
        self.heard.append(("steer", *asked))

    def act(self, action):
        self.heard.append(("act", action))

    def find_heading(self, direction, viewer):
        return 90.0 - math.degrees(math.atan2(*direction))

    def find_lock(self):
        return self.locked

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
        ("steer", 1.2, pytest.approx(180.0), 70.0),
        ("steer", 1.2, pytest.approx(45.0), 70.0),
        ("steer", 0.0, None, 70.0),
        ("steer", 1.2, pytest.approx(180.0), None),
    ]


def test_a_locked_facing_holds_in_all_directions_and_the_right_stick_goes_before_it(deck):
    deck.locked = -30.0
    deck.hold("KeyW", at=0.0)
    deck.locked = -35.0
    deck.driving.step(0.2)
    assert deck.heard == [("steer", 1.2, 90.0, -30.0), ("steer", 1.2, 90.0, -35.0)]
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


LIMITS = InputLimits(3.8, {"gait": ["run", "walk"], "style": ["old"]})
ANYTHING = st.one_of(
    st.floats(), st.integers(), st.text(max_size=5), st.none(), st.booleans(), st.lists(st.floats(), max_size=2)
)
CHANGES = st.dictionaries(st.sampled_from(["speed", "heading", "facing", "step_length"]), ANYTHING)


@settings(max_examples=40, suppress_health_check=[HealthCheck.too_slow])  # on a starved core
@given(CHANGES, CHANGES)
def test_whatever_is_asked_the_inputs_are_a_command_within_limits(first, second):
    inputs = SteeringInputs()
    for changes in (first, second):
        inputs, _ = LIMITS.change(inputs, changes)
        assert inputs.command.within(3.8) == (inputs.command, [])
        assert abs(inputs.heading) <= 180
        assert inputs.facing is None or abs(inputs.facing) <= 180


@pytest.mark.parametrize(
    ("name", "asked", "held", "text"),
    [
        ("speed", -5.0, 0.0, "A speed of -5 m/s is out of range: 0 to 3.8 m/s."),
        ("speed", 1e9, 3.8, "A speed of 1e+09 m/s is out of range: 0 to 3.8 m/s."),
        ("speed", math.nan, 1.2, "'nan' is not a speed in m/s."),
        ("speed", "fast", 1.2, "'fast' is not a speed in m/s."),
        ("step_length", 99.0, 1.2, "A step length of 99 m is out of range: 0.3 to 1.2 m."),
        ("heading", 370, 10.0, None),
        ("facing", math.inf, None, "'inf' is not a facing in degrees."),
        ("facing", None, None, None),
    ],
)
def test_what_is_impossible_is_limited_and_explained(name, asked, held, text):
    inputs, notes = LIMITS.change(SteeringInputs(), {name: asked})
    assert getattr(inputs, name) == held
    assert notes == ([] if text is None else [text])


def test_labels_are_of_the_prior_and_of_one_group_at_a_time():
    inputs, notes = LIMITS.change(SteeringInputs(), {"labels": {"gait": "run"}})
    inputs, more = LIMITS.change(inputs, {"labels": {"style": "old"}})
    assert notes + more == []
    assert inputs.command == Command(1.2, 0.0, labels=("gait=run", "style=old"))
    inputs, notes = LIMITS.change(inputs, {"labels": {"gait": "swim", "mood": "bad"}})
    assert inputs.labels == {"gait": "run", "style": "old"}
    assert notes[0] == "'swim' is not a gait of this prior."
    assert LIMITS.change(inputs, {"labels": {"gait": UNCONDITIONED}})[0].labels == {"style": "old"}


@pytest.mark.parametrize("value", ["x", (1, 2), (math.nan, 0, 0), (0, 1e9, 0), None])
def test_points_are_finite_and_near(value):
    assert parse_point(value) is None
    assert parse_point([1, 2, 3.5]) == (1.0, 2.0, 3.5)
