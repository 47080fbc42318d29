"""The live viewer without a browser: what controls do to characters, what is shown, recorded and drawn."""

import math
import socket
import time

import numpy as np
import pytest
import trimesh
from helpers import run as run_command
from helpers import walk

from mapctl import formats
from mapctl.commands.live import Live
from mapctl.errors import MapctlError, RequestError
from mapctl.skeleton import CANONICAL
from mapctl.steering import Command
from mapctl.streaming import Delivered, LiveCharacter
from scenes.live import ground
from scenes.live import recording as recording_module
from scenes.live.gauges import Gauges
from scenes.live.orders import Orders
from scenes.live.recording import Recording, as_file, as_some_file, keep
from scenes.live.show import Show


def delivered(first: int = 0, count: int = 3, *, spare: float = 0.02) -> Delivered:
    """Some frames of a walk, due now."""
    motion = walk(90).slice(first, first + count)
    joints = motion.joint_positions().numpy()
    return Delivered(time.perf_counter(), first / 30, motion.root_position.numpy(), motion.local_quat_xyzw.numpy(),
                     np.tile([1.0, 0.0], (count, 1)), joints, (0.0, 1.2), {"noise": 1.0, "travel": 0.5}, spare,
                     0.05, 12)  # fmt: skip


class Actor:
    """A LiveCharacter that notes what it is told."""

    skeleton = CANONICAL

    def __init__(self):
        self.heard: list[tuple] = []
        self.frames = 0

    def command(self, command):
        self.heard.append(("command", command))

    def walk(self, points, speed):
        if len(points) < 2:
            raise RequestError("a curve needs two points")
        self.heard.append(("walk", points, speed))

    def pause(self, paused):
        self.heard.append(("pause", paused))

    def reset(self):
        self.heard.append(("reset",))

    def poll(self):
        self.frames += 3
        return [delivered(self.frames - 3)] if self.frames < 80 else []

    def close(self):
        self.heard.append(("close",))


@pytest.fixture
def actors():
    return [Actor(), Actor()]


@pytest.fixture
def show(actors):
    made = Show(
        actors, [Orders(), Orders()], port=8090, fastest=3.8, labels={"gait": ["run", "walk"], "style": ["old"]}
    )
    yield made
    made.close()
    assert all(actor.heard[-1] == ("close",) for actor in actors)


@pytest.fixture
def said(show, capsys):
    """What the page says, and the console since the last time."""

    def heard() -> tuple[str, str]:
        lines = (show._notices._top, show._notices._refusals)
        return " ".join(line.content for line in lines if line.visible), capsys.readouterr().err

    return heard


def run(show, ticks: int = 20) -> None:
    left = iter(range(ticks))
    show.run(lambda: next(left, None) is None)


def test_it_listens_on_this_machine_only(show):
    assert show.url.startswith("http://127.0.0.1:")
    assert show.server.get_host() == "127.0.0.1"
    assert isinstance(Actor(), LiveCharacter)


def test_a_port_that_is_taken_is_said_and_another_one_serves(monkeypatch, capsys, prior):
    """As `mapctl live` does it; the process of a character is left out."""
    actor = Actor()
    monkeypatch.setattr(Live, "_characters", lambda live: [actor])
    monkeypatch.setattr(Show, "run", lambda show: (_ for _ in ()).throw(KeyboardInterrupt))
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        port = other.getsockname()[1]
        assert run_command("live", "--port", port, "--prior", prior) == 0
    taken, opened, _ = capsys.readouterr().out.split("\n", 2)
    assert taken == f"port {port} is in use"
    assert opened.startswith("open http://127.0.0.1:")
    assert f":{port} " not in opened
    assert actor.heard[-1] == ("close",)


def test_orders_go_to_the_chosen_character_alone_and_the_panel_shows_them(show, actors):
    show.order(speed=2.0, heading=90.0)
    show.choose(1)
    show.order(speed=0.5, facing=-90.0, told={"gait": "walk", "style": "old"})
    run(show)
    assert actors[0].heard == [("command", Command(2.0, math.pi / 2))]
    assert actors[1].heard == [("command", Command(0.5, 0.0, -math.pi / 2, told=("walk", "old")))]
    panel = show._panel
    assert (panel.speed.value, panel.facing.value, panel.told["gait"].value) == (0.5, -90, "walk")
    show.choose(0)
    run(show)
    assert (panel.speed.value, panel.heading.value, panel.told["gait"].value) == (2.0, 90, "any")
    assert len(actors[0].heard) == 1, "to show orders is not to give them"


def test_pause_and_reset_are_for_everybody(show, actors):
    show.toggle_pause()
    run(show, 2)
    assert show._panel.paused.label == "Go on"
    show.toggle_pause()
    show.order(speed=3.0)
    show.reset()
    run(show, 2)
    for actor in actors:
        assert [word for word, *_ in actor.heard if word != "command"] == ["pause", "pause", "reset"]
    assert actors[0].heard[-2] == ("command", Command(1.2, 0.0)), "the first orders come back"


def test_frames_stand_the_puppet_where_they_say(show, actors):
    run(show, 30)
    frame = show._members[0].place
    assert np.hypot(*frame) > 0.3
    np.testing.assert_allclose(show._world.position, [-frame[0], 0, -frame[1]], atol=1e-9)
    show._panel.follow.value = False
    run(show, 1)
    np.testing.assert_allclose(show._world.position, 0)


def test_a_drawn_path_is_given_to_walk_and_none_is_said(show, actors):
    show.walk_path()
    run(show, 1)
    assert actors[0].heard == []
    for place in ((0.0, 0.0), (1.0, 1.0), (1.0, 3.0)):
        show._path.add(*place)
    show.walk_path()
    show.clear_path()
    run(show, 1)
    assert actors[0].heard == [("walk", [(0.0, 0.0), (1.0, 1.0), (1.0, 3.0)], 1.2)]
    assert show._path.points == []


def test_rays_meet_the_ground():
    assert ground.on_the_ground(np.array([0.0, 2, 0]), np.array([0.0, -1, 1])) == (0.0, 2.0)
    assert ground.on_the_ground(np.array([0.0, 2, 0]), np.array([0.0, 0, 1])) is None
    assert ground.on_the_ground(np.array([0.0, 2, 0]), np.array([0.0, 1, 1])) is None
    assert ground.on_the_ground(np.array([0.0, 2, 0]), np.array([0.0, -0.01, 1])) is None, "200 m away"


@pytest.mark.parametrize("ending", ["bvh", "glb"])
def test_a_recording_is_the_motion_that_was_shown(ending, tmp_path):
    recording = Recording(CANONICAL)
    with pytest.raises(RequestError, match="nothing was recorded"):
        recording.motion()
    for first in range(0, 30, 3):
        recording.add(delivered(first))
    motion, whole = recording.motion(), walk(90).slice(0, 30)
    np.testing.assert_allclose(motion.joint_positions(), whole.joint_positions(), atol=1e-9)
    path = tmp_path / f"x.{ending}"
    path.write_bytes(as_file(motion, ending))
    if ending == "bvh":
        read = formats.load(path)
        order = [read.skeleton.index(name) for name in CANONICAL.names]  # a BVH lists joints depth first
        np.testing.assert_allclose(read.joint_positions()[:, order], whole.joint_positions(), atol=1e-5)
    else:
        assert len(trimesh.load(path).geometry) == 1


def test_a_recording_can_be_a_film():
    assert as_file(walk(8), "mp4")[4:8] == b"ftyp"


def test_a_recording_begins_and_ends_with_the_button(show, actors):
    show.toggle_recording(None)
    run(show, 5)
    assert show._panel.record.label == "Stop and save"
    recording = show._members[0].recording
    assert len(recording.pieces) == 5
    show.toggle_recording(None)
    run(show, 2)
    assert show._panel.record.label == "Record"
    assert len(recording.pieces) == 5
    assert show._members[1].recording is None


def test_gauges_count_late_frames_and_know_the_speed(show):
    gauges = Gauges(show.server.gui)
    for first in range(0, 30, 3):
        gauges.add(delivered(first, spare=-0.04 if first == 27 else 0.01), 30)
    gauges.show()
    assert (gauges.frames, gauges.late) == (30, 2)
    way = walk(90).root_position[:30, ::2]
    assert gauges.speed == pytest.approx(float((way[29] - way[14]).norm()) * 2, rel=1e-6)
    assert "2 of 30 frames late" in gauges._text.content
    assert [len(plot.data) for plot in gauges._plots] == [3, 3]


def test_what_is_typed_is_clamped_said_and_put_right_when_typing_ends(show, actors, said):
    panel = show._panel
    panel.speed._impl.value = 99.0  # as the server has it when a browser sent it
    show.typed(speed=99.0)
    run(show, 2)
    assert actors[0].heard == [("command", Command(3.8, 0.0))]
    assert panel.speed.value == 99.0, "somebody may still be typing"
    assert said() == ("A speed of 99 m/s was lowered to 3.8: it can be 0 to 3.8 m/s.", "")
    run(show, 80)
    assert panel.speed.value == 3.8
    assert "99" in said()[0], "it stays to be read"


def test_a_number_typed_digit_by_digit_arrives_as_it_was_meant(show, actors, said):
    show.order(step_length=0.65)
    run(show, 1)
    field = show._panel.step_length
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
    assert show._panel.heading.value == 165
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
    assert len(show._members[1].recording.pieces) == 13
    assert len(show._members[0].recording.pieces) == (3 if where == "poll" else 13)


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
        assert len(show._members[0].recording.pieces) == 3
    show.reset()
    run(show, 3)
    assert said()[0] == ""
    assert len(show._members[0].recording.pieces) == 6


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
    def made_up(motion, ending):
        if ending == "mp4":
            raise OSError("no space left")
        return b"HIERARCHY"

    monkeypatch.setattr(recording_module, "as_file", made_up)
    made = as_some_file(walk(8), "mp4")
    assert (made.name, made.content, made.why) == ("mapctl.bvh", b"HIERARCHY", "no space left")
    assert [keep(made, tmp_path).name for _ in range(3)] == ["mapctl.bvh", "mapctl-2.bvh", "mapctl-3.bvh"]
    assert (tmp_path / "mapctl-3.bvh").read_bytes() == b"HIERARCHY"


def test_a_recording_that_goes_on_when_all_ends_is_kept(show, tmp_path):
    assert show.keep_recordings(tmp_path) == []
    show.toggle_recording(None)
    run(show, 5)
    [path] = show.keep_recordings(tmp_path)
    assert formats.load(path).num_frames == 15
    assert show.keep_recordings(tmp_path) == []


def test_a_recording_for_somebody_who_left_is_written_here_where_nobody_else_is(show, said, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    recording = Recording(CANONICAL)
    recording.add(delivered())
    show._hand_out(recording, "bvh", None)
    assert formats.load(tmp_path / "mapctl.bvh").num_frames == 3
    assert "nobody is left to take the recording" in said()[1]
    show._hand_out(Recording(CANONICAL), "bvh", None)
    assert "Nothing saved: RequestError: nothing was recorded" in said()[1]


def test_drawn_points_are_few_and_near(show):
    show._panel.draw.value = True
    down = (0.0, -1.0, 0.0)
    for ray in (None, [1.0], [math.nan] * 3, [1e300, 1, 0], "abc"):
        show._draw_at(ray, down)
        show._draw_at((0.0, 1.0, 0.0), ray)
    run(show, 2)
    assert show._path.points == []
    for number in range(300):
        show._draw_at((number % 20, 1.0, number % 7), down)
    run(show, 2)
    assert len(show._path.points) == 200
