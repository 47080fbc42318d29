"""The live viewer without a browser: what users do reaches the characters, errors end nothing, the past is shown."""

import math
import re
import socket

import numpy as np
import pytest
from helpers import run as run_command
from helpers import walk
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from stage import Actor, delivered, live_app, run

from controllers.steering.process import CharacterProcess
from mapctl import formats
from mapctl.commands import live
from mapctl.curves.obstacles import Obstacle
from mapctl.errors import MapctlError, RequestError
from mapctl.intent.steering import Command
from scenes.live.app import LiveApp
from scenes.live.camera import CameraMode
from scenes.live.character import CharacterLook
from scenes.live.inputs import ACTIONS
from scenes.live.page import PageState
from scenes.live.recording import FORMATS, encode_motion, join_chunks, write_new

DOWN = (0.0, -1.0, 0.0)


def words(actor: Actor, *kinds: str) -> list[tuple]:
    return [heard for heard in actor.heard if heard[0] in kinds]


def test_it_listens_on_this_machine_only(show):
    assert show.url.startswith("http://127.0.0.1:")
    assert show.server.get_host() == "127.0.0.1"
    assert {name for name in vars(CharacterProcess) if name[0] != "_"} - {"wait", "pid"} <= {*dir(Actor)}


def test_a_port_that_is_taken_is_named_and_another_one_serves(monkeypatch, capsys, prior):
    actor = Actor()
    monkeypatch.setattr(live, "_start_characters", lambda *_: [actor])
    monkeypatch.setattr(LiveApp, "run", lambda show: (_ for _ in ()).throw(KeyboardInterrupt))
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


def test_inputs_go_to_the_chosen_character_alone_and_the_panel_shows_them(show, actors):
    show.change(show.chosen, speed=2.0, heading=math.pi / 2)
    show.choose(1)
    show.change(show.chosen, speed=0.5, facing=-math.pi / 2)
    show.label(show.chosen, "gait", "walk")
    show.label(show.chosen, "style", "old")
    assert actors[0].heard == [("command", Command(2.0, math.pi / 2))]
    wanted = Command(0.5, 0.0, -math.pi / 2, labels=("gait=walk", "style=old"))
    assert actors[1].heard[-1] == ("command", wanted)
    panel = show.panel
    assert (panel.speed.value, panel.facing.value, panel.labels["gait"].value) == (0.5, -90, "walk")
    show.choose(0)
    assert (panel.speed.value, panel.heading.value, panel.labels["gait"].value) == (2.0, 90, "any")
    assert len(actors[0].heard) == 1, "to show inputs is not to send them"


def test_pause_and_reset_are_for_all_characters(show, actors):
    show.set_paused(True)
    assert show.panel.paused.label == "Resume"
    run(show, 2)
    assert show.chosen.past == []
    show.set_paused(False)
    show.change(show.chosen, speed=3.0)
    show.restart()
    for actor in actors:
        assert [word for word, *_ in actor.heard if word != "command"] == ["pause", "pause", "reset"]
    assert actors[0].heard[-2] == ("command", Command(1.2, 0.0)), "the first inputs come back"


def test_frames_are_shown_where_they_say_and_the_world_moves_past_the_camera(show):
    chunk = delivered(60)
    show.chosen.character.poll = lambda: [chunk]
    run(show, 3)
    position = show.chosen.position
    assert position[0] == 0
    assert chunk.root[0, 2] <= position[1] <= chunk.root[-1, 2]
    assert np.dot(show.view._world.position[[0, 2]], position) < 0
    assert "frames late" in show.chosen.describe_status()
    assert re.search(r"facing (2[6-9]|3[01])° off", show.chosen.describe_status())  # of 0.5 radians
    show.view.chase.mode = CameraMode.FREE
    before = np.array(show.view._world.position)
    run(show, 5)
    np.testing.assert_array_equal(show.view._world.position, before)


def test_keys_and_sticks_reach_the_character(show, actors):
    show.driving.update(0, PageState(keys={"KeyX", "KeyN"}))
    show.driving.update(0, PageState(stick=(0.0, -1.0, 0.0)))
    show.driving.step(0.0)
    assert actors[1].heard[-1][1].speed == 1.2
    show.driving.update(0, None)
    show.driving.step(0.1)
    assert actors[1].heard[-1][1].speed == 0.0
    show.driving.update(1, PageState(keys=set(ACTIONS)))
    assert {word for word, *_ in actors[0].heard} == {"command", "pause", "reset"}


def test_a_lock_faces_the_target_as_the_character_passes_it(show, actors):
    show.change(show.chosen, speed=1.0)
    show.targets.look(True)
    show.targets.move_target((3.0, 1.1, 0.0))
    show.chosen.position = np.array([0.0, 0.0])
    show.act("KeyL")
    assert actors[0].heard[-1][1].facing == pytest.approx(math.pi / 2)
    show.chosen.position = np.array([3.0, -2.0])
    show.driving.update(0, PageState(keys={"KeyD"}))
    show.driving.step(0.0)
    assert actors[0].heard[-1][1].facing == pytest.approx(0.0)
    show.act("KeyL")
    assert actors[0].heard[-1][1].facing is None


def test_poses_are_shown_between_frames(show):
    chunk = delivered(60)
    show.chosen.character.poll = lambda: [chunk]
    show.chosen.receive()
    (first, second, _), body = show.chosen._waiting, show.chosen._body
    shown = []
    body.pose = shown.append
    show.chosen.show_due(first.due + 0.25 / 30)
    assert len(shown) == 2, "the frame that is due, and the pose after it"
    expected = first.pose[0] + 0.25 * (second.pose[0] - first.pose[0])
    np.testing.assert_allclose(shown[-1][0], expected, atol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(shown[-1][1], axis=-1), 1.0)
    assert np.abs(shown[-1][1] - first.pose[1]).max() > 1e-6
    np.testing.assert_allclose(show.chosen.position, (0.75 * chunk.root[0] + 0.25 * chunk.root[1])[::2], atol=1e-6)


def test_a_drawn_path_is_walked_and_a_missing_one_is_named(show, actors, capsys):
    run(show, 1)

    show.enqueue(show.walk_path)
    run(show, 1)
    assert "Not done: a curve needs two points" in capsys.readouterr().err
    show.view.chase.mode = CameraMode.FREE
    show.panel.draw.value = True
    rays = [(show.view.chase.to_view(np.array([x, 2.0, z])), DOWN) for x, z in ((0.0, 0.0), (1.0, 1.0), (1.0, 3.0))]
    for one in rays:
        show.click(*one)
    show.enqueue(lambda: show.click(None, DOWN))
    run(show, 1)
    show.path.edit(show.path.points, closed=True)
    show.walk_path()
    _, points, speed, closed = actors[0].heard[-1]
    np.testing.assert_allclose(points, [(0, 0), (1, 1), (1, 3)], atol=1e-9)
    assert (speed, closed) == (1.2, True)
    assert show.view.find_ground(*rays[1]) == pytest.approx((1.0, 1.0))
    for direction in ((0.0, 0.0, 1.0), (0.0, 1.0, 1.0), (0.0, -0.01, 1.0)):
        assert show.view.find_ground((0.0, 2.0, 0.0), direction) is None


def test_a_click_sends_the_chosen_character_there(show, actors):
    panel = show.panel
    panel.go.value, panel.within.value = True, 1.5
    show.click((1.0, 5.0, 2.0), DOWN)
    _, command, position, within, facing = actors[0].heard[-1]
    assert (position, within, facing) == (pytest.approx((1.0, 2.0)), 1.5, None)
    assert command.speed > 0
    panel.turns.value, panel.turn.value, panel.then.value = True, 90.0, "stand"
    show.click((1.0, 5.0, 2.0), DOWN)
    _, command, _, _, facing = actors[0].heard[-1]
    assert (command.speed, facing, panel.speed.value) == (0.0, pytest.approx(math.pi / 2), 0.0)
    panel.within.value = math.nan
    with pytest.raises(RequestError, match="the time must be a finite number"):
        show.click((9.0, 5.0, 9.0), DOWN)
    assert actors[0].heard[-1][2] == pytest.approx((1.0, 2.0)), "no slider gives that"


def test_a_target_appears_is_dragged_and_belongs_to_its_character(show, actors):
    targets, point = show.targets, (1.0, 1.1, 2.0)
    targets.reach("leftHand")
    word, first = actors[0].heard[-1]
    assert (word, set(first.reach)) == ("aim", {"leftHand"})
    assert targets.target.visible
    targets.move_target(point)
    targets.look(True)
    assert (actors[0].heard[-1][1].reach, actors[0].heard[-1][1].look_at) == ({"leftHand": point}, point)
    show.choose(1)
    assert not targets.target.visible
    assert actors[1].heard == []
    show.choose(0)
    show.change(show.chosen, speed=2.0)
    assert actors[0].heard[-1] == ("command", Command(2.0, 0.0, reach={"leftHand": point}, look_at=point))
    targets.reach(None)
    targets.look(False)
    assert actors[0].heard[-1][1] == Command(2.0, 0.0)


def test_a_disc_is_for_all_characters(show, actors):
    targets = show.targets
    targets.put_disc(0.5)
    assert [actor.heard[-1][1].obstacles[0].radius for actor in actors] == [0.5, 0.5]
    targets.move_disc((1.0, 0.0, 4.0))
    targets.put_disc(0.8)
    assert actors[1].heard[-1][1].obstacles == (Obstacle((1.0, 4.0), 0.8),)
    targets.put_disc(None)
    assert actors[0].heard[-1][1].obstacles == ()
    assert not targets.disc.visible


@settings(max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow])
@given(st.dictionaries(st.sampled_from(["speed", "heading", "facing"]), st.floats()))
def test_whatever_a_control_sends_the_command_is_within_limits(show, changes):
    before = show.chosen.wanted
    try:
        show.change(show.chosen, **changes)
    except RequestError:
        assert show.chosen.wanted is before
    assert show.chosen.wanted.within(3.8) == (show.chosen.wanted, [])


def test_what_is_limited_or_refused_is_explained(show, capsys):
    show.change_from_panel(speed=1e9)
    assert show.chosen.wanted.speed == 3.8
    assert "the speed of 1e+09 m/s was lowered to 3.80 m/s" in capsys.readouterr().err
    for speed, reason in ((-5.0, "0 m/s or more, got -5"), (math.nan, "speed must be a finite number")):
        with pytest.raises(RequestError, match=reason):
            show.change_from_panel(speed=speed)
    with pytest.raises(RequestError, match="'swim' is not a gait of this prior"):
        show.label(show.chosen, "gait", "swim")
    show.label(show.chosen, "gait", "run")
    show.label(show.chosen, "gait", "any")
    assert show.chosen.wanted == Command(3.8, 0.0)


@pytest.mark.parametrize("where", ["poll", "command"])
def test_an_error_in_one_character_ends_no_other_and_no_recording(show, actors, capsys, monkeypatch, where):
    def broken(*given):
        raise ZeroDivisionError("oh\nno")

    for character in show.characters:
        character.recorded = []
    run(show, 3)
    monkeypatch.setattr(actors[0], where, broken)
    show.enqueue(lambda: [show.change(one, speed=2.0) for one in show.characters])
    show.enqueue(lambda: show.change(show.characters[1], speed=2.0))
    show.enqueue(lambda: show.set_paused(True))
    show.enqueue(lambda: show.set_paused(False))
    show.enqueue(show.restart)
    run(show, 10)
    assert capsys.readouterr().err == "mapctl: Something went wrong: ZeroDivisionError: oh no\n"
    assert {word for word, *_ in actors[1].heard} == {"command", "pause", "reset"}
    assert len(show.characters[1].recorded) == 13


def test_a_character_that_has_ended_is_named_keeps_its_recording_and_comes_back(show, actors, capsys, monkeypatch):
    def gone():
        raise MapctlError("it crashed")

    show.chosen.recorded = []
    run(show, 3)
    with monkeypatch.context() as patched:
        patched.setattr(actors[0], "poll", gone)
        run(show, 3)
    assert "it crashed" in show.chosen.describe_status()
    assert capsys.readouterr().err == "mapctl: Character 1: it has ended: it crashed. Reset restarts it\n"
    assert (len(show.chosen.recorded), actors[1].frames) == (3, 18)
    show.restart()
    run(show, 3)
    assert len(show.chosen.recorded) == 6
    assert "frames late" in show.chosen.describe_status()


def test_too_slow_a_machine_is_reported(show, actors, monkeypatch):
    monkeypatch.setattr(actors[0], "poll", lambda: [delivered(0, spare=-0.2)])
    run(show, 12)
    assert "too slow" in show.chosen.describe_status()
    assert "too slow" not in show.characters[1].describe_status()


def test_looking_back_shows_what_was_while_the_characters_wait(show, actors):
    run(show, 30)
    character = show.chosen
    frames = len(character.past)
    assert frames > 20
    show.timeline.look_back(0.5)
    run(show, 2)
    assert [words(actor, "pause") for actor in actors] == [[("pause", True)]] * 2
    past = character.past[frames - 1 - 15]
    np.testing.assert_array_equal(character.position, past.chunk.root[past.frame, ::2])
    assert "Past, 0.5 s ago" in show.timeline.describe()
    show.timeline.look_back(1e9)
    run(show, 16)
    assert show.timeline.seconds_back == pytest.approx(frames / 30)
    assert show.panel.back.value == pytest.approx(-frames / 30, abs=0.06)
    show.timeline.return_to_present()
    assert words(actors[0], "pause")[-1] == ("pause", False)
    newest = character.past[-1]
    np.testing.assert_array_equal(character.position, newest.chunk.root[newest.frame, ::2])


def test_a_replay_ends_in_the_present(show, actors):
    run(show, 10)
    show.timeline.replay()
    began = show.timeline._replayed
    show.timeline.step(began + 0.1)
    assert "Replay" in show.timeline.describe()
    assert show.timeline.seconds_back == pytest.approx(len(show.chosen.past) / 30 - 0.1)
    show.timeline.step(began + 100.0)
    assert (show.timeline.seconds_back, show.is_paused) == (None, False)


@pytest.mark.parametrize("ending", FORMATS)
def test_a_recording_is_the_motion_that_was_shown(show, tmp_path, monkeypatch, ending):
    monkeypatch.chdir(tmp_path)
    show.panel.ending.value = ending
    show.recorder.toggle(show.chosen, ending, None)
    with pytest.raises(RequestError, match="nothing was recorded"):
        show.recorder.toggle(show.chosen, ending, None)
    show.recorder.toggle(show.chosen, ending, None)
    run(show, 5)
    assert show.panel.record.label == "Stop and save"
    show.recorder.toggle(show.chosen, show.panel.ending.value, None)
    show.recorder.wait()
    recorded = formats.load(tmp_path / f"mapctl.{ending}")
    whole = walk(90).slice(0, 15)
    order = [recorded.skeleton.index(name) for name in whole.skeleton.names]
    np.testing.assert_allclose(recorded.joint_positions()[:, order], whole.joint_positions(), atol=1e-4)


def test_a_recording_that_goes_on_when_all_ends_is_saved(show, tmp_path):
    assert show.save_recordings(tmp_path) == []
    show.recorder.toggle(show.chosen, "bvh", None)
    run(show, 5)
    [path] = show.save_recordings(tmp_path)
    assert (path.name, formats.load(path).num_frames) == ("mapctl.bvh", 15)
    assert show.save_recordings(tmp_path) == []
    assert write_new(path, b"x").name == "mapctl-2.bvh"


def test_a_recording_keeps_its_licence_on_any_rig(actors, tmp_path):
    look = CharacterLook(on_rig=lambda motion: walk(3), licence="CC0 1.0 (mine)")
    with live_app(actors, look) as show:
        motion = join_chunks(show.chosen, [delivered()])
    (tmp_path / "x.glb").write_bytes(encode_motion(motion, "glb"))
    assert formats.load(tmp_path / "x.glb").licence == "CC0 1.0 (mine)"
