"""Orders over OSC: their syntax, and what is no order."""

import math

import pytest

from mapctl.errors import RequestError
from mapctl.streaming.messages import Message
from mapctl.streaming.orders import Order, keep_latest, read_order

GROUPS = ("gait", "style")


def read(address: str, *arguments: object, characters: int = 3) -> Order:
    return read_order(Message(address, arguments), characters=characters, groups=GROUPS)


@pytest.mark.parametrize(
    ("address", "arguments", "order"),
    [
        ("/mapctl/speed", (1.5,), Order(0, "speed", (1.5,))),
        ("/mapctl/speed", (2,), Order(0, "speed", (2.0,))),
        ("/mapctl/3/heading", (90.0,), Order(2, "heading", (90.0,))),
        ("/mapctl/stop", (), Order(0, "stop")),
        ("/mapctl/style", ("old",), Order(0, "style", word="old")),
        ("/mapctl/2/hand/left", (0.1, 1.2, 3.0), Order(1, "hand/left", (0.1, 1.2, 3.0))),
        ("/mapctl/hand/right", (), Order(0, "hand/right")),
        ("/mapctl/place", (1.0, 2.0, 1.5), Order(0, "place", (1.0, 2.0, 1.5))),
        ("/mapctl/path", (0.0, 0.0, 1.0, 1.0), Order(0, "path", (0.0, 0.0, 1.0, 1.0))),
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
        ("/mapctl/path", (1.0, 2.0, 3.0), "x and z of 2 to 200 points"),
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
        read("/mapctl/stop"),
        read("/mapctl/speed", 2.0),
    ]
    assert keep_latest(orders) == [orders[1], orders[2], orders[3]]
