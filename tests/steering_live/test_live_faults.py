"""What goes wrong in one place of the live viewer ends nothing elsewhere, and is said; so is what cannot be."""

import itertools
import math

import msgspec
import pytest
import viser
from helpers import walk
from stage import delivered, run
from websockets.sync.client import connect

from mapctl import formats
from mapctl.errors import MapctlError
from mapctl.intent.steering import Command
from mapctl.skeleton import CANONICAL
from scenes.live import recording as recording_module
from scenes.live.paths import points
from scenes.live.recording import Recording, encode_with_fallback, save_without_replacing


@pytest.fixture
def said(show, capsys):
    """What the page says, and the console since the last time."""

    def heard() -> tuple[str, str]:
        lines = (show._notices._top, show._notices._refusals)
        return " ".join(line.content for line in lines if line.visible), capsys.readouterr().err

    return heard


@pytest.mark.slow
def test_what_is_typed_is_clamped_said_and_put_right_when_typing_ends(show, actors, said):
    panel = show._panel
    panel.steering.speed._impl.value = 99.0  # as the server has it when a browser sent it
    show.typed(speed=99.0)
    run(show, 2)
    assert actors[0].heard == [("command", Command(3.8, 0.0))]
    assert panel.steering.speed.value == 99.0, "somebody may still be typing"
    assert said() == ("A speed of 99 m/s was lowered to 3.8: it can be 0 to 3.8 m/s.", "")
    run(show, 80)
    assert panel.steering.speed.value == 3.8
    assert "99" in said()[0], "it stays to be read"


@pytest.mark.slow
def test_a_number_typed_digit_by_digit_arrives_as_it_was_meant(show, actors, said):
    show.order(step_length=0.65)
    run(show, 1)
    field = show._panel.steering.step_length
    for text in ("0", "0.8", "0.85"):
        field._impl.value = float(text)
        show.typed(step_length=float(text))
        run(show, 15)
        assert field.value == float(text), "nothing is put into the field while it is typed into"
    run(show, 80)
    assert field.value == 0.85
    assert actors[0].heard[-1] == ("command", Command(1.2, 0.0, step_length=0.85))
    assert [order.step_length for _, order in actors[0].heard] == [0.65, 0.3, 0.8, 0.85]
    assert "step length" not in said()[0], "0 was but the beginning of a number"


def test_keys_go_as_far_as_they_go_without_a_word(show, actors, said):
    for _ in range(30):
        show.nudge(speed=0.2)
    show.nudge(heading=-180.0)
    show.nudge(heading=-15.0)
    run(show, 2)
    assert actors[0].heard[-1][1].speed == 3.8
    assert show._panel.steering.heading.value == 165
    assert said() == ("", "")


@pytest.mark.parametrize("where", ["poll", "command", "reset", "pause"])
def test_an_error_in_one_character_ends_nobody_else_and_no_recording(show, actors, said, monkeypatch, where):
    def broken(*given):
        raise ZeroDivisionError("oh\nno")

    for number in (0, 1):
        show.choose(number)
        show.toggle_recording(None)
    run(show, 3)
    monkeypatch.setattr(actors[0], where, broken)
    for number in (0, 1):
        show.choose(number)
        show.order(speed=2.0)
        show.toggle_pause()
        show.toggle_pause()
    show.reset()
    run(show, 10)
    assert said()[1] == "mapctl: Something went wrong: ZeroDivisionError: oh no\n"
    assert {word for word, *_ in actors[1].heard} == {"command", "pause", "reset"}
    assert show._cast.members[1].recording.frames == 39
    assert show._cast.members[0].recording.frames == (9 if where == "poll" else 39)


def test_a_character_that_is_no_more_is_said_keeps_its_recording_and_comes_back(show, actors, said, monkeypatch):
    def gone():
        raise MapctlError("it ended")

    show.toggle_recording(None)
    run(show, 3)
    with monkeypatch.context() as patched:
        patched.setattr(actors[0], "poll", gone)
        run(show, 3)
        page, console = said()
        assert "character 1 is no more: it ended" in page
        assert console.count("\n") == 1
        assert actors[1].frames == 18
        assert show._cast.members[0].recording.frames == 9
    show.reset()
    run(show, 3)
    assert said()[0] == ""
    assert show._cast.members[0].recording.frames == 18


@pytest.mark.slow  # what is too slow: test_live_realtime.py
def test_too_slow_is_said_in_the_page_and_on_the_console_and_so_is_its_end(show, actors, said, monkeypatch):
    monkeypatch.setattr(actors[1], "poll", lambda: [delivered(0, spare=-0.2)])
    monkeypatch.setattr(actors[0], "poll", lambda: [delivered(0, spare=0.02)])
    run(show, 40)
    page, console = said()
    assert "character 2 is too slow for this machine: " in page
    assert "100 % of its frames come late, 12 evaluations a step" in page
    assert console.count("character 2 is too slow") == console.count("\n") == 1
    monkeypatch.setattr(actors[1], "poll", lambda: [delivered(0, spare=0.02)])
    run(show, 180)
    assert said() == ("", "mapctl: character 2 keeps up again\n")


def test_a_file_that_cannot_be_made_comes_as_another_and_nothing_is_lost(monkeypatch, tmp_path):
    def made_up(motion, ending, drawn=None, work=None):
        if ending == "mp4":
            raise OSError("no space left")
        return b"HIERARCHY"

    monkeypatch.setattr(recording_module, "encode_motion", made_up)
    made = encode_with_fallback(walk(8), "mp4")
    assert (made.name, made.content, made.fallback_reason) == ("mapctl.bvh", b"HIERARCHY", "no space left")
    assert [save_without_replacing(made, tmp_path).name for _ in range(3)] == [
        "mapctl.bvh",
        "mapctl-2.bvh",
        "mapctl-3.bvh",
    ]
    assert (tmp_path / "mapctl-3.bvh").read_bytes() == b"HIERARCHY"


def test_a_recording_that_goes_on_when_all_ends_is_kept(show, tmp_path):
    assert show.save_recordings(tmp_path) == []
    show.toggle_recording(None)
    run(show, 5)
    [path] = show.save_recordings(tmp_path)
    assert formats.load(path).num_frames == 15
    assert show.save_recordings(tmp_path) == []


def test_a_recording_for_somebody_who_left_is_written_here_where_nobody_else_is(show, said, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    recording = Recording(CANONICAL)
    recording.add(delivered())
    show._recorder._delivery.export(recording, "bvh", None)
    assert formats.load(tmp_path / "mapctl.bvh").num_frames == 3
    assert "nobody is left to take the recording" in said()[1]
    show._recorder._delivery.export(Recording(CANONICAL), "bvh", None)
    assert "Nothing saved: RequestError: nothing was recorded" in said()[1]


def test_drawn_points_are_few_and_near(show, monkeypatch):
    monkeypatch.setattr(points, "MAX_POINTS", 12)
    show._panel.path.draw.value = True
    down = (0.0, -1.0, 0.0)
    for ray in (None, [1.0], [math.nan] * 3, [1e300, 1, 0], "abc"):
        show._draw_at(ray, down)
        show._draw_at((0.0, 1.0, 0.0), ray)
    run(show, 2)
    assert show.path.path.points == []
    for number in range(20):
        show._draw_at((number % 20, 1.0, number % 7), down)
    run(show, 2)
    assert len(show.path.path.points) == 12


VALUES = (
    -5,
    99,
    1e9,
    -1e300,
    math.nan,
    math.inf,
    0,
    0.8,
    True,
    None,
    "",
    "-",
    "abc",
    "-5",
    "any",
    "swim",
    [],
    [1, 2],
    {},
)


CAMERA = {
    "type": "ViewerCameraMessage",
    "wxyz": (1.0, 0.0, 0.0, 0.0),
    "position": (0.0, 0.0, 0.0),
    "fov": 1.0,
    "near": 0.1,
    "far": 9.0,
    "image_height": 9,
    "image_width": 9,
    "look_at": (0.0, 0.0, 1.0),
    "up_direction": (0.0, 1.0, 0.0),
}


def controls(show):
    """All that a browser can set a value of."""
    return [handle for handle in vars(show._panel).values() if isinstance(handle, viser.GuiInputHandle)] + [
        *show._panel.steering.labels.values()
    ]


@pytest.mark.slow  # without browsers: test_live_inputs.py
def test_whatever_two_browsers_send_every_command_can_be_obeyed_and_the_recording_is_whole(show, actors, said):
    """As pages send it, past what their fields let through."""
    show.toggle_recording(None)
    own = f"http://127.0.0.1:{show.server.get_port()}"
    how = {"origin": own, "subprotocols": [f"viser-v{viser.__version__}"], "max_queue": None}
    opened = [connect(own.replace("http", "ws"), **how) for _ in range(2)]
    for browser in opened:
        browser.send(msgspec.msgpack.encode(CAMERA))  # before that a page is none to viser
    sent = itertools.product(VALUES, controls(show))
    for number, (value, handle) in enumerate(sent):
        message = {"type": "GuiUpdateMessage", "uuid": handle._impl.uuid, "updates": {"value": value}}
        opened[number % 2].send(msgspec.msgpack.encode(message))
        if number % 10 == 0:
            run(show, 1)
    run(show, 90)
    for browser in opened:
        browser.close()
    commands = [command for word, command, *_ in actors[0].heard + actors[1].heard if word == "command"]
    assert len(commands) > 30
    assert all(command.within(3.8) == (command, []) for command in commands)
    assert {label for command in commands for label in command.labels} <= {"gait=run", "gait=walk", "style=old"}
    _, console = said()
    assert "Traceback" not in console
    assert "went wrong" not in console
    frames = show._cast.members[0].recording.motion().num_frames
    assert frames == actors[0].frames
    panel, orders = show._panel, show._cast.chosen.orders
    assert (panel.steering.speed.value, panel.steering.heading.value) == (orders.speed, round(orders.heading))
