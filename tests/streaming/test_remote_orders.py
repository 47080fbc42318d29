"""Orders over OSC on the stage: obeyed as the page's are, within the same limits, and shown in its panel."""

import math
from contextlib import contextmanager

import pytest
from stage import Actor, live_app, run

from mapctl.intent.steering import Command
from mapctl.streaming.messages import Message
from mapctl.streaming.sender import guide


class Source:
    """An OscReceiver that a test fills."""

    def __init__(self):
        self.waiting: list[Message] = []
        self.dropped, self.fault = 0, ""

    def poll(self):
        found, self.waiting = self.waiting, []
        return found


class Stream:
    """A PoseStream that notes what it gets."""

    def __init__(self):
        self.heard: list[tuple] = []

    def put(self, character, chunk):
        assert len(guide(chunk)) == len(chunk.root)
        self.heard.append(("put", character, chunk.seconds, len(chunk.root)))

    def forget(self, character):
        self.heard.append(("forget", character))


@contextmanager
def staged():
    """Two characters, the viewer, and a function that sends messages and lets it look once."""
    actors, source, stream = [Actor(), Actor()], Source(), Stream()
    with live_app(actors, source=source, stream=stream) as show:

        def send(*messages: tuple):
            source.waiting += [Message(f"/mapctl/{name}", tuple(arguments)) for name, *arguments in messages]
            run(show, 1)

        yield show, actors, stream, send


@pytest.fixture
def stage():
    with staged() as result:
        yield result


def words(actor: Actor) -> list[str]:
    return [word for word, *_ in actor.heard]


@pytest.mark.slow
def test_numbers_and_labels_become_the_command_of_their_character(stage):
    show, actors, _, send = stage
    send(("speed", 2.0), ("heading", 90.0), ("style", "old"), ("2/speed", 0.5), ("2/facing", -90.0))
    assert actors[0].heard[-1] == ("command", Command(2.0, math.pi / 2, labels=("style=old",)))
    assert actors[1].heard[-1] == ("command", Command(0.5, 0.0, -math.pi / 2))
    assert (show.panel.speed.value, show.panel.heading.value) == (2.0, 90)
    assert show.panel.labels["style"].value == "old"
    send(("2/facing",), ("style", "any"), ("speed", 0.0))
    assert actors[1].heard[-1] == ("command", Command(0.5, 0.0))
    assert actors[0].heard[-1] == ("command", Command(0.0, math.pi / 2))
    send(("speed", 0.0), ("speed", 1.0))
    assert actors[0].heard[-1][1].speed == 1.0, "the last of what came counts"


def test_hands_reach_together_and_let_go_alone(stage):
    _, actors, _, send = stage
    send(("hand/left", 1.0, 1.1, 2.0), ("hand/right", -1.0, 1.2, 2.0), ("look", 0.0, 1.5, 9.0))
    word, command = actors[0].heard[-1]
    assert word == "aim"
    assert command.reach == {"leftHand": (1.0, 1.1, 2.0), "rightHand": (-1.0, 1.2, 2.0)}
    assert command.look_at == (0.0, 1.5, 9.0)
    assert set(words(actors[0])) == {"aim"}
    send(("hand/left",))
    assert actors[0].heard[-1][1].reach == {"rightHand": (-1.0, 1.2, 2.0)}
    send(("speed", 1.0))
    assert actors[0].heard[-1][1].reach == {"rightHand": (-1.0, 1.2, 2.0)}
    send(("hand/right",), ("look",))
    assert (actors[0].heard[-1][1].reach, actors[0].heard[-1][1].look_at) == ({}, None)


def test_positions_are_gone_to_after_what_else_came(stage):
    _, actors, _, send = stage
    send(("goto", 1.0, 2.0), ("speed", 0.0))
    assert words(actors[0]) == ["command", "go"]
    _, command, position, within, facing = actors[0].heard[-1]
    assert (command.speed, position, within, facing) == (0.0, (1.0, 2.0), 2.0, None)
    send(("2/goto", -1.0, 3.0, 1.5, 450.0))
    assert actors[1].heard[-1][2:] == ((-1.0, 3.0), 1.5, pytest.approx(math.pi / 2))
    send(("goto", 1.0, 2.0, 99.0))
    assert actors[0].heard[-1][3] == 10.0


def test_a_pause_and_a_restart_are_for_all_characters(stage):
    show, actors, stream, send = stage
    send(("pause",))
    send(("pause", 1))
    assert [a.heard[-1] for a in actors] == [("pause", True)] * 2
    assert show.panel.paused.label == "Resume"
    send(("pause", 0.0))
    assert [a.heard[-1] for a in actors] == [("pause", False)] * 2
    send(("hand/left", 1.0, 1.0, 1.0))
    send(("reset",))
    assert [words(a)[-1] for a in actors] == ["reset"] * 2
    assert show.chosen.wanted.reach == {}
    assert [entry for entry in stream.heard if entry[0] == "forget"] == [("forget", 0), ("forget", 1)]


def test_every_frame_goes_to_the_stream_too(stage):
    show, actors, stream, _ = stage
    run(show, 4)
    put = [entry for entry in stream.heard if entry[0] == "put"]
    assert [sum(entry[3] for entry in put if entry[1] == k) for k in (0, 1)] == [actor.frames for actor in actors]


@pytest.mark.slow
@pytest.mark.parametrize(
    "message",
    [
        ("hand/left", 1e6, 0.0, 0.0),
        ("look", 0.0, -1e300, 0.0),
        ("goto", 1e5, 0.0),
        ("goto", 0.0, math.nan),
        ("3/speed", 1.0),
        ("dance",),
        ("gait", 3.0),
        ("speed", "fast"),
    ],
)
def test_an_impossible_request_is_reported_and_changes_nothing(stage, capsys, message):
    show, actors, _, send = stage
    before = show.chosen.wanted
    send(message)
    run(show, 20)
    assert show.chosen.wanted == before
    assert {word for actor in actors for word in words(actor)} <= {"aim"}, "the same as before is aimed at"
    assert capsys.readouterr().err.startswith("mapctl: OSC: ")
