"""Commands, tracks and the ramp between them; and the files that hold them."""

import math
from fractions import Fraction
from itertools import pairwise

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from mapctl.curves.obstacles import Obstacle
from mapctl.errors import FileFormatError, RequestError
from mapctl.intent.steering import (
    STEP_LENGTHS,
    Arrival,
    Command,
    CommandTrack,
    SteeringLimits,
    SteeringTarget,
    read_commands,
)

ANGLES = st.floats(-20, 20)
SPEEDS = st.floats(0, 5)


@given(ANGLES, ANGLES, SPEEDS, SPEEDS)
def test_a_command_approaches_its_target_within_the_limits_and_the_shorter_turn(heading, wanted, speed, asked):
    limits, command = SteeringLimits(acceleration=2, braking=3, turn_rate=2.5), Command(asked, wanted)
    target = SteeringTarget(speed, heading, heading)
    requests = [target, *target.ahead(command, limits, frames=90, fps=30)]
    for before, after in pairwise(requests):
        assert -3 / 30 - 1e-9 <= after.speed - before.speed <= 2 / 30 + 1e-9
        assert abs(after.heading - before.heading) <= 2.5 / 30 + 1e-9
        assert after.speed >= 0
    assert requests[-1].speed == pytest.approx(asked)
    assert math.remainder(requests[-1].heading - wanted, 2 * math.pi) == pytest.approx(0, abs=1e-6)
    assert abs(requests[-1].heading - heading) <= math.pi + 1e-6


HAND = "left_hand_x,left_hand_y,left_hand_z"


def test_speeds_beyond_the_priors_are_lowered_and_reported():
    track, said = CommandTrack((0.0, 1.0), (Command(50, 0), Command(1, 0))).limit_speed(3.0)
    assert [command.speed for command in track.commands] == [3.0, 1.0]
    assert said == ["the speed of 50 m/s at 0 s was lowered to 3.00 m/s, the prior's fastest"]


def test_impossible_steps_are_brought_near_and_reported():
    held, said = Command(1.0, 0, step_length=99.0).within(3.0)
    assert held == Command(1.0, 0, step_length=STEP_LENGTHS[1])
    assert said == ["the step length of 99 m was lowered to 1.2 m; steps can be 0.3 to 1.2 m long"]
    held, said = Command(9.0, 0, step_length=0.01).within(3.0, when=" at 2 s")
    assert (held.speed, held.step_length) == (3.0, STEP_LENGTHS[0])
    assert [sentence[:36] for sentence in said] == [
        "the speed of 9 m/s at 2 s was lowere",
        "the step length of 0.01 m at 2 s was",
    ]


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        (lambda: Command(-1, 0), "speed must be"),
        (lambda: Command(math.nan, 0), "speed must be"),
        (lambda: Command(1, math.inf), "heading must be"),
        (lambda: Command(1, 0, math.nan), "facing must be"),
        (lambda: Command(1, 0, turning=math.inf), "turning must be"),
        (lambda: Command(1, 0, reach={"leftFoot": (0, 0, 0)}), "reaches with leftHand or rightHand, not with leftFoot"),
        (lambda: Command(1, 0, reach={"leftHand": (0, 0, math.nan)}), "leftHand must be three finite numbers"),
        (lambda: Command(1, 0, look_at=(0, 1, math.inf)), "look_at must be three finite numbers"),
        (lambda: CommandTrack((), ()), "at least one"),
        (lambda: CommandTrack((1.0, 1.0), (Command(1, 0),) * 2), "must rise, got 1 s after 1 s"),
        (lambda: SteeringLimits(turn_rate=0), "turn_rate must be positive"),
    ],
)
def test_what_cannot_be_is_refused(wrong, message):
    with pytest.raises(RequestError, match=message):
        wrong()


def plain(kind, *values, **named):
    """Build without the tests' own check of types, which users do not have."""
    found = object.__new__(kind)
    kind.__init__.__wrapped__(found, *values, **named)
    return found


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        (lambda: plain(Command, "1.2", 0), "speed must be a finite number, got '1.2'"),
        (lambda: plain(Command, np.array([1.0, 2.0]), 0), "speed must be a finite number"),
        (lambda: plain(Command, torch.ones(2), 0), "speed must be a finite number"),
        (lambda: plain(Command, 1, None), "heading must be a finite number"),
        (lambda: plain(Command, 1, 10**400), "heading must be a finite number"),
        (lambda: plain(Command, 1, 0, step_length=0), "step length must be positive"),
        (lambda: plain(Command, 1, 0, reach=[3]), "reaches with leftHand or rightHand"),
        (lambda: plain(Command, 1, 0, reach={"leftHand": "abc"}), "leftHand must be three finite numbers"),
        (lambda: plain(Command, 1, 0, look_at=3.0), "look_at must be three finite numbers"),
        (lambda: plain(Command, 1, 0, labels="run"), "labels must be a sequence of names, got 'run'"),
        (lambda: plain(Command, 1, 0, labels=(3,)), "labels must be a sequence of names"),
        (lambda: plain(Command, 1, 0, obstacles=[(0, 1, 2)]), "must be a sequence of Obstacle"),
        (lambda: plain(Command, 1, 0, obstacles=Obstacle((0, 1), 0.3)), "must be a sequence of Obstacle"),
        (lambda: plain(Command, 1, 0, arrival=(1, 2)), "must be an Arrival"),
        (lambda: plain(Arrival, (1, 2, 3), 1), "position of an arrival must be two finite numbers"),
        (lambda: plain(Arrival, (1, 2), "soon"), "by must be a finite number"),
        (lambda: plain(Arrival, (1, 2), 1, facing=math.nan), "facing must be a finite number"),
        (lambda: plain(Arrival, (1, 2), 1, pose=3), "pose of an arrival must be a Motion"),
        (lambda: plain(Obstacle, (math.nan, 0), 0.3), "position of an obstacle must be two finite numbers"),
        (lambda: plain(Obstacle, (0, 0), "wide"), "radius of an obstacle must be a finite number"),
        (lambda: plain(Obstacle, (0, 0), size=(1, 2, 3)), "size of an obstacle must be two finite numbers"),
        (lambda: plain(Obstacle, (0, 0), size=(1, 0)), "must be positive"),
        (lambda: plain(SteeringLimits, braking="hard"), "braking must be a finite number"),
    ],
)
def test_what_is_of_another_type_is_refused_in_a_line(wrong, message):
    with pytest.raises(RequestError, match=message):
        wrong()


@pytest.mark.parametrize("number", [np.float32, np.array, torch.tensor, Fraction])
def test_numbers_of_any_library_become_pythons(number):
    point = np.array([0.5, 1.0, 2.0], dtype=np.float32)
    reach, look_at = {"leftHand": point}, torch.tensor(point)
    command = plain(Command, number(1.5), number(0.25), step_length=number(0.5), reach=reach, look_at=look_at)
    assert command == Command(1.5, 0.25, step_length=0.5, reach={"leftHand": (0.5, 1, 2)}, look_at=(0.5, 1, 2))
    assert {type(value) for value in (command.speed, command.heading, command.step_length, *command.look_at)} == {float}
    assert plain(Arrival, point[:2], number(1.5)) == Arrival((0.5, 1.0), 1.5)
    assert plain(Obstacle, point[:2], number(0.5)) == Obstacle((0.5, 1.0), 0.5)


@pytest.fixture
def read(tmp_path):
    def written(text: str, encoding: str = "utf-8"):
        (tmp_path / "commands.csv").write_bytes(text.encode(encoding))
        return read_commands(tmp_path / "commands.csv")

    return written


def test_columns_in_any_order_with_a_facing_that_may_be_empty(read):
    track = read("\ufeffheading_deg, time_s,speed_mps,facing_deg\r\n90,0,1.2,\r\n\r\n0,2.5,0,-90\r\n")
    assert track.times == (0, 2.5)
    assert [(c.speed, c.heading, c.facing) for c in track.commands] == [
        (1.2, pytest.approx(math.pi / 2), None),
        (0, 0, pytest.approx(-math.pi / 2)),
    ]


def test_turning_gait_and_style_may_be_left_empty(read):
    track = read("time_s,speed_mps,heading_deg,turn_deg_s,gait,style\n0,1,0,,run,\n1,1,0,-90,, elderly\n2,1,0,,,\n")
    assert [command.turning for command in track.commands] == [None, pytest.approx(-math.pi / 2), None]
    assert [command.labels for command in track.commands] == [("run",), ("elderly",), ()]
    lowered, _ = track.limit_speed(0.5)
    assert [(c.turning, c.labels, c.speed) for c in lowered.commands] == [
        (c.turning, c.labels, 0.5) for c in track.commands
    ]


@pytest.mark.parametrize(
    ("text", "line", "message"),
    [
        ("", None, "the file is empty"),
        ("time_s,heading_deg\n0,1\n", 1, "has no column speed_mps"),
        ("time_s,speed_mps,heading_deg,time_s\n0,1,0,1\n", 1, "each once"),
        ("time_s,speed_mps,heading_deg\n", None, "holds no commands"),
        ("time_s,speed_mps,heading_deg\n0,1\n", 2, "found 2 values where 3 belong"),
        ("time_s,speed_mps,heading_deg\n0,nan,0\n", 2, "speed_mps must be a number, got"),
        ("time_s,speed_mps,heading_deg\n2,1,0\n1,1,0\n", 3, "time_s must rise, got 1 after 2"),
        ("time_s,speed_mps,heading_deg,look_x,look_y\n0,1,0,1,2\n", 2, "look needs look_x, look_y, look_z"),
        (f"time_s,speed_mps,heading_deg,{HAND}\n0,1,0,1,2,1e5\n", 2, "left_hand_z must lie"),
    ],
)
def test_bad_files_are_named_with_their_line(read, text, line, message):
    with pytest.raises(FileFormatError, match=message) as given:
        read(text)
    assert given.value.line == line


def test_places_hold_for_their_line_alone(read):
    track = read(f"time_s,speed_mps,heading_deg,{HAND},look_x,look_y,look_z\n0,1,0,0.4,1.2,3,,,\n1,1,0,,,,0,1,2\n")
    assert [command.reach for command in track.commands] == [{"leftHand": (0.4, 1.2, 3.0)}, {}]
    assert [command.look_at for command in track.commands] == [None, (0.0, 1.0, 2.0)]
