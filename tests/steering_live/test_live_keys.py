"""Keys, sticks and messages of the page: what they ask of a character, and what nonsense does, which is nothing."""

import asyncio
import json
import math
from contextlib import suppress

import pytest
from hypothesis import given
from hypothesis import strategies as st

from mapctl.errors import RequestError
from scenes.live.page.channel import PATH, PageChannel
from scenes.live.page.driving import Driving
from scenes.live.page.gamepad import list_presses, read_pad
from scenes.live.page.keys import ACTIONS, KEYS, REPEAT_AFTER, KeyAction, find_direction, list_help
from scenes.live.page.messages import HeldKeys, PadGone, PadState, PageLayout, parse_message
from scenes.live.view.framing import Box


class Deck:
    """Notes what it is asked; the camera looks along +X."""

    def __init__(self):
        self.heard: list[tuple] = []

    def order(self, **changes):
        self.heard.append(("order", changes))

    def nudge(self, **by):
        self.heard.append(("nudge", by))

    def act(self, action):
        self.heard.append(("act", action))

    def turn_camera(self, angle):
        self.heard.append(("turn", round(angle, 6)))

    def find_heading(self, direction, viewer):
        return 90.0 - math.degrees(math.atan2(*direction))


@pytest.fixture
def said() -> list[tuple[str, str]]:
    return []


@pytest.fixture
def deck() -> Deck:
    return Deck()


@pytest.fixture
def driving(deck, said) -> Driving:
    return Driving(deck, fastest=3.8, tell=lambda *words: said.append(words))


def hold(*codes: str) -> HeldKeys:
    return HeldKeys(frozenset(codes))


def test_a_held_key_walks_as_the_camera_sees_it_and_letting_go_stands(driving, deck):
    driving.hear(0, hold("KeyW"))
    for k in range(30):
        driving.step(k / 60)
    assert deck.heard == [("order", {"speed": 1.2, "heading": 90.0})], "the same is not ordered again"
    driving.hear(0, hold("KeyW", "ShiftLeft", "KeyA"))
    driving.step(1.0)
    assert deck.heard[-1] == ("order", {"speed": pytest.approx(2.85), "heading": pytest.approx(135.0)})
    driving.hear(0, hold())
    driving.step(1.01)
    driving.step(1.02)
    assert deck.heard[2:] == [("order", {"speed": 0.0})]


def test_a_tap_that_is_over_before_anybody_looked_does_nothing_lasting(driving, deck):
    driving.hear(0, hold("KeyD"))
    driving.hear(0, hold())
    driving.step(0.0)
    assert deck.heard == []


def test_orders_follow_a_camera_that_turns_but_not_more_often_than_ten_times_a_second(driving, deck):
    angle = iter(range(1000))
    deck.find_heading = lambda direction, viewer: float(next(angle))
    driving.hear(0, hold("ArrowLeft"))
    for k in range(120):
        driving.step(k / 60)
    assert 15 <= len(deck.heard) <= 21


def test_a_browser_that_vanishes_lets_go(driving, deck):
    driving.hear(3, hold("KeyS"))
    driving.step(0.0)
    driving.hear(3, None)
    driving.step(0.1)
    assert deck.heard[-1] == ("order", {"speed": 0.0})


def test_of_two_pages_the_first_drives_until_it_lets_go(driving, deck):
    driving.hear(0, hold("KeyW"))
    driving.step(0.0)
    driving.hear(1, hold("KeyS"))
    driving.step(0.2)
    assert len(deck.heard) == 1
    driving.hear(0, hold())
    driving.step(0.4)
    assert deck.heard[-1] == ("order", {"speed": 1.2, "heading": pytest.approx(-90.0)})


def test_keys_may_be_faster_slower_and_turns_and_repeat_while_they_are_held(driving, deck):
    driving.from_camera = False
    driving.hear(0, hold("KeyW"))
    for k in range(61):
        driving.step(k / 60)
    nudges = [by for word, by in deck.heard if word == "nudge"]
    assert nudges == [{"speed": 0.2}] * len(nudges)
    assert len(nudges) == 1 + 1 + int((1.0 - REPEAT_AFTER) / 0.1), "at once, after a while, and on"
    deck.heard.clear()
    driving.hear(0, hold("KeyA", "ShiftLeft"))
    driving.hear(0, hold())
    assert deck.heard == [("nudge", {"heading": 30.0})], "a tap turns once, with Shift twice as far"


def test_single_keys_act_once_however_long_they_are_held(driving, deck):
    driving.hear(0, hold("KeyX"))
    driving.hear(0, hold("KeyX", "KeyP"))
    driving.step(0.0)
    driving.step(5.0)
    assert deck.heard == [("act", KeyAction.STAND), ("act", KeyAction.PAUSE)]


def test_q_and_e_turn_the_camera_as_long_as_they_are_held(driving, deck):
    driving.hear(0, hold("KeyQ"))
    for k in range(3):
        driving.step(k / 60)
    assert deck.heard[-1] == ("turn", pytest.approx(math.radians(100) / 60, abs=1e-5))


def pad(right: float = 0, down: float = 0, look: float = 0, **pressed: float) -> PadState:
    buttons = [0.0] * 17
    for name, value in pressed.items():
        buttons[int(name[1:])] = value
    return PadState((right, down, look, 0.0), tuple(buttons))


def test_a_stick_walks_with_its_push_and_a_trigger_runs(driving, deck, said):
    driving.hear(0, pad(0.1, -0.1))
    driving.step(0.0)
    assert deck.heard == [], "sticks never rest at zero"
    driving.hear(0, pad(0.0, -1.0))
    driving.step(0.1)
    assert deck.heard == [("order", {"speed": 1.2, "heading": pytest.approx(90.0)})]
    driving.hear(0, pad(0.0, -1.0, b7=1.0))
    driving.step(0.3)
    assert deck.heard[-1][1]["speed"] == pytest.approx(2.85)
    assert said == [("Gamepad", "it steers: left stick walks, right trigger runs")]


def test_a_gamepad_that_is_unplugged_ends_its_order_and_is_said(driving, deck, said):
    driving.hear(0, pad(1.0, 0.0))
    driving.step(0.0)
    driving.hear(0, PadGone())
    driving.step(0.1)
    assert deck.heard[-1] == ("order", {"speed": 0.0})
    assert said[-1] == ("Gamepad", "it was unplugged; the character stands")
    driving.hear(0, PadGone())
    assert len(said) == 2


def test_buttons_act_when_they_are_pressed_and_the_right_stick_turns():
    assert list_presses(None, pad(b0=1.0)) == [KeyAction.STAND]
    assert list_presses(pad(b0=1.0), pad(b0=1.0, b3=1.0)) == [KeyAction.NEXT]
    assert read_pad(pad(look=1.0)).turn == -1.0
    assert read_pad(pad(look=0.1)).turn == 0.0
    half = read_pad(pad(0.565, 0.0))
    assert half.strength == pytest.approx(0.5)
    assert half.direction == pytest.approx((1.0, 0.0))


def test_directions_add_up_and_opposite_ones_are_none():
    assert find_direction({"KeyW"}) == (0.0, 1.0)
    assert find_direction({"KeyW", "ArrowUp", "KeyD"}) == pytest.approx((0.5**0.5, 0.5**0.5))
    assert find_direction({"KeyW", "KeyS"}) is None
    assert find_direction({"KeyX"}) is None


@pytest.mark.parametrize("from_camera", [True, False])
def test_the_list_of_keys_names_every_key(from_camera):
    text = " ".join(key for key, _ in list_help(from_camera=from_camera))
    assert all(code.removeprefix("Key") in text for code in ACTIONS)
    assert {"W", "A", "S", "D", "Q", "E", "Shift"} <= set(text.replace(",", " ").split())
    assert "Shift" in text


def test_messages_are_what_they_say():
    assert parse_message('{"keys": ["KeyW", "ShiftLeft"]}') == hold("KeyW", "ShiftLeft")
    assert parse_message('{"pad": null}') == PadGone()
    assert parse_message('{"pad": {"axes": [0, -1], "buttons": [1]}}') == pad(0.0, -1.0, b0=1.0)
    layout = {"canvas": [0, 40, 900, 700], "panel": [600, 50, 300, 400], "viewer": 2, "dark": True}
    assert parse_message(json.dumps({"layout": layout})) == PageLayout((900, 700), Box(600, 10, 300, 400), 2, True)


NONSENSE = [
    "",
    "{",
    "[]",
    "3",
    "null",
    '{"keys": "KeyW"}',
    '{"keys": ["KeyZ"]}',
    '{"keys": [["KeyW"]]}',
    '{"keys": [], "pad": null}',
    '{"pad": {"axes": [1e9], "buttons": []}}',
    '{"pad": {"axes": ["x"], "buttons": []}}',
    '{"pad": {"axes": [NaN], "buttons": []}}',
    '{"pad": {}}',
    '{"layout": {"canvas": [0, 0, 0, 0]}}',
    '{"layout": {"canvas": [0, 0, 9, 9], "viewer": "x"}}',
    '{"layout": {"canvas": [0, 0, 9, 9], "panel": [1]}}',
    '{"other": 1}',
    "[" * 1900,
    "x" * 5000,
    b"\xff",
    None,
]


@pytest.mark.parametrize("text", NONSENSE)
def test_nonsense_is_no_message(text):
    with pytest.raises(RequestError):
        parse_message(text)


NAMES = st.sampled_from(["axes", "buttons", "canvas", "panel", "viewer", "x"])
PLAIN = st.none() | st.floats() | st.text() | st.booleans() | st.integers()
CONTENT = st.recursive(PLAIN, lambda inner: st.lists(inner) | st.dictionaries(NAMES, inner), max_leaves=8)


@pytest.mark.slow
@given(CONTENT, st.sampled_from(["keys", "pad", "layout"]))
def test_whatever_comes_is_a_message_or_refused(content, kind):
    with suppress(RequestError):
        parse_message(json.dumps({kind: content}))


class Socket:
    """Of a page that sends these and goes."""

    def __init__(self, *sent):
        self.sent, self.got = list(sent), []

    async def send(self, text):
        self.got.append(text)

    async def __aiter__(self):
        for one in self.sent:
            yield one


def test_what_is_no_message_is_dropped_counted_and_said_once_a_minute():
    channel, told = PageChannel(), []
    asyncio.run(channel.serve(Socket('{"keys": ["KeyW"]}', "{", "nonsense", '{"keys": []}')))
    assert channel.poll() == [(0, hold("KeyW")), (0, hold()), (0, None)]
    assert channel.dropped == 2
    channel.report(100.0, told.append)
    channel.report(101.0, told.append)
    asyncio.run(channel.serve(Socket("{")))
    channel.report(130.0, told.append)
    channel.report(161.0, told.append)
    assert told == [
        "2 messages of a page were dropped: a message that is no JSON",
        "1 messages of a page were dropped: a message that is no JSON",
    ]


def test_the_script_needs_the_page_s_token():
    channel = PageChannel()
    assert channel.admits("/")
    assert channel.admits("/index.html?x=1")
    assert not channel.admits(PATH)
    assert not channel.admits(f"{PATH}?token=x")
    page = channel.insert_script(b"<html><head><title/></head></html>", None).decode()
    token = page.split('data-token="')[1].split('"')[0]
    assert channel.admits(f"{PATH}?token={token}")
    assert PageChannel().admits(f"{PATH}?token={token}") is False
    assert page.index("<script") < page.index("<title")
    assert set(page.split('data-keys="')[1].split('"')[0].split()) == KEYS
