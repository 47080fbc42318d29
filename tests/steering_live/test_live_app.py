"""The live viewer without a browser: what controls do to characters, what is shown, recorded and drawn."""

import math
import socket

import numpy as np
import pytest
import trimesh
from helpers import run as run_command
from helpers import walk
from stage import Actor, delivered, run

from mapctl import formats
from mapctl.commands.live import run as live
from mapctl.curves.obstacles import Obstacle
from mapctl.errors import RequestError
from mapctl.intent.steering import Command
from mapctl.runtime.live_protocol import LiveCharacter
from mapctl.skeleton import CANONICAL
from scenes.live import ground
from scenes.live.app import LiveApp
from scenes.live.readouts import Readouts
from scenes.live.recording import Recording, encode_motion
from scenes.live.view.chase import CameraMode


def test_it_listens_on_this_machine_only(show):
    assert show.url.startswith("http://127.0.0.1:")
    assert show.server.get_host() == "127.0.0.1"
    assert isinstance(Actor(), LiveCharacter)


def test_a_port_that_is_taken_is_said_and_another_one_serves(monkeypatch, capsys, prior):
    """As `mapctl live` does it; the process of a character is left out."""
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


@pytest.mark.slow
def test_orders_go_to_the_chosen_character_alone_and_the_panel_shows_them(show, actors):
    show.order(speed=2.0, heading=90.0)
    show.choose(1)
    show.order(speed=0.5, facing=-90.0, labels={"gait": "walk", "style": "old"})
    run(show)
    assert actors[0].heard == [("command", Command(2.0, math.pi / 2))]
    assert actors[1].heard == [("command", Command(0.5, 0.0, -math.pi / 2, labels=("gait=walk", "style=old")))]
    panel = show._panel.steering
    assert (panel.speed.value, panel.facing.value, panel.labels["gait"].value) == (0.5, -90, "walk")
    show.choose(0)
    run(show)
    assert (panel.speed.value, panel.heading.value, panel.labels["gait"].value) == (2.0, 90, "any")
    assert len(actors[0].heard) == 1, "to show orders is not to give them"


def test_pause_and_reset_are_for_everybody(show, actors):
    show.toggle_pause()
    run(show, 2)
    assert show._panel.play.paused.label == "Go on"
    show.toggle_pause()
    show.order(speed=3.0)
    show.reset()
    run(show, 2)
    for actor in actors:
        assert [word for word, *_ in actor.heard if word != "command"] == ["pause", "pause", "reset"]
    assert actors[0].heard[-2] == ("command", Command(1.2, 0.0)), "the first orders come back"


@pytest.mark.slow
def test_frames_stand_the_puppet_where_they_say(show, actors):
    for _ in range(40):  # it walks; how far in so many frames depends on how busy the machine is
        run(show, 30)
        if np.hypot(*show._cast.members[0].place) > 0.1:
            break
    frame = show._cast.members[0].place
    assert np.hypot(*frame) > 0.1
    world = show._view._director._world
    assert np.dot(world.position[[0, 2]], frame) < 0, "the world goes past the camera"
    show._view.set_camera(CameraMode.FREE)
    run(show, 1)
    before = np.array(world.position)
    run(show, 30)
    np.testing.assert_array_equal(world.position, before)


def test_a_drawn_path_is_given_to_walk_and_none_is_said(show, actors):
    show.walk_path()
    run(show, 1)
    assert actors[0].heard == []
    for place in ((0.0, 0.0), (1.0, 1.0), (1.0, 3.0)):
        show.path.place(*place)
    show.walk_path()
    show.path.clear()
    run(show, 1)
    assert actors[0].heard == [("walk", [(0.0, 0.0), (1.0, 1.0), (1.0, 3.0)], 1.2)]
    assert show.path.path.points == []


def test_a_target_appears_is_dragged_and_belongs_to_its_character(show, actors):
    show.targets.aim(hand="left")
    run(show, 1)
    word, first = actors[0].heard[-1]
    assert word == "aim"
    assert set(first.reach) == {"leftHand"}
    assert show.targets._target._handle.visible
    show.targets.aim(target=(1.0, 1.1, 2.0))
    show.targets.aim(looks=True)
    run(show, 1)
    assert actors[0].heard[-1][1].reach == {"leftHand": (1.0, 1.1, 2.0)}
    assert actors[0].heard[-1][1].look_at == (1.0, 1.1, 2.0)
    assert actors[1].heard == []
    show.choose(1)
    run(show, 1)
    assert not show.targets._target._handle.visible
    show.choose(0)
    show.order(speed=2.0)
    run(show, 1)
    assert actors[0].heard[-1] == (
        "command",
        Command(2.0, 0.0, reach={"leftHand": (1.0, 1.1, 2.0)}, look_at=(1.0, 1.1, 2.0)),
    )


def test_a_disc_is_for_everybody_and_is_dragged_and_taken_away(show, actors):
    show.targets.put_disc(0.5)
    run(show, 1)
    assert [actor.heard[-1][1].obstacles[0].radius for actor in actors] == [0.5, 0.5]
    assert show.targets._disc._handle.visible
    show.targets._move_disc((1.0, 0.0, 4.0))
    show.targets.put_disc(0.8)
    run(show, 1)
    assert actors[1].heard[-1][1].obstacles == (Obstacle((1.0, 4.0), 0.8),)
    show.targets.put_disc(None)
    run(show, 1)
    assert actors[0].heard[-1][1].obstacles == ()
    assert not show.targets._disc._handle.visible


def test_what_no_page_of_ours_sends_changes_no_target(show, actors):
    show.targets.aim(hand="left", target=(0.0, 1.0, 2.0))
    show.targets.put_disc(0.5)
    run(show, 1)
    heard = actors[0].heard[-1]
    for wrong in ({"hand": "third"}, {"target": (math.nan, 0.0, 0.0)}, {"target": "x"}, {"looks": 3}):
        show.targets.aim(**wrong)
    for radius in (math.inf, -1.0, True):
        show.targets.put_disc(radius)
    run(show, 1)
    assert actors[0].heard[-1] == heard


def test_rays_meet_the_ground():
    assert ground.intersect_ground(np.array([0.0, 2, 0]), np.array([0.0, -1, 1])) == (0.0, 2.0)
    assert ground.intersect_ground(np.array([0.0, 2, 0]), np.array([0.0, 0, 1])) is None
    assert ground.intersect_ground(np.array([0.0, 2, 0]), np.array([0.0, 1, 1])) is None
    assert ground.intersect_ground(np.array([0.0, 2, 0]), np.array([0.0, -0.01, 1])) is None, "200 m away"


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
    path.write_bytes(encode_motion(motion, ending))
    if ending == "bvh":
        read = formats.load(path)
        order = [read.skeleton.index(name) for name in CANONICAL.names]  # a BVH lists joints depth first
        np.testing.assert_allclose(read.joint_positions()[:, order], whole.joint_positions(), atol=1e-5)
    else:
        assert len(trimesh.load(path).geometry) == 1


def test_a_recording_tells_its_licence_and_so_does_the_file_that_grows(tmp_path):
    recording = Recording(CANONICAL, folder=tmp_path, on_rig=lambda motion: walk(3), licence="CC0 1.0 (mine)")
    recording.add(delivered(0))
    assert formats.load(tmp_path / "mapctl.recording").licence == "CC0 1.0 (mine)"
    assert recording.motion().licence == "CC0 1.0 (mine)"
    (tmp_path / "x.glb").write_bytes(encode_motion(recording.motion(), "glb"))
    assert formats.load(tmp_path / "x.glb").licence == "CC0 1.0 (mine)"


@pytest.mark.slow
def test_a_recording_can_be_a_film():
    assert encode_motion(walk(3), "mp4")[4:8] == b"ftyp"


@pytest.mark.slow
def test_a_recording_begins_and_ends_with_the_button(show, actors):
    show.toggle_recording(None)
    run(show, 5)
    assert show._panel.recording.record.label == "Stop and save"
    recording = show._cast.members[0].recording
    assert recording.frames == 15
    show.toggle_recording(None)
    run(show, 2)
    assert show._panel.recording.record.label == "Record"
    assert recording.frames == 15
    assert show._cast.members[1].recording is None


def test_gauges_count_late_frames_and_know_the_speed(show):
    gauges = Readouts(show.server.gui)
    gauges.add_plots()
    for first in range(0, 30, 3):
        gauges.add(delivered(first, spare=-0.04 if first == 27 else 0.01), 30)
    gauges.show()
    assert (gauges.frames, gauges.late) == (30, 2)
    way = walk(90).root_position[:30, ::2]
    assert gauges.speed == pytest.approx(float((way[29] - way[14]).norm()) * 2, rel=1e-6)
    assert "2 of 30 frames late" in gauges._text.content
    assert [len(plot.data) for plot in gauges._plots] == [3, 3]


def test_a_click_sends_the_chosen_one_there(show, actors):
    show._draw_at((1.0, 5.0, 2.0), (0.0, -1.0, 0.0))
    run(show, 1)
    assert not [heard for heard in actors[0].heard if heard[0] == "go"]  # clicks are for nothing yet
    show._going.on.value, show._going.within.value = True, 1.5
    show._draw_at((1.0, 5.0, 2.0), (0.0, -1.0, 0.0))
    run(show, 1)
    _, command, place, within, facing = actors[0].heard[-1]
    assert (place, within, facing) == (pytest.approx((1.0, 2.0)), 1.5, None)
    assert command.speed > 0
    show._going.faces.value, show._going.facing.value, show._going.then.value = True, 90.0, "stand"
    show._draw_at((1.0, 5.0, 2.0), (0.0, -1.0, 0.0))
    run(show, 1)
    _, command, _, _, facing = actors[0].heard[-1]
    assert (command.speed, facing) == (0.0, pytest.approx(math.pi / 2))
    assert show._panel.steering.speed.value == 0.0


@pytest.mark.parametrize("wrong", [0.0, math.nan, 1e300])
def test_times_that_no_slider_gives_send_nobody(show, actors, wrong):
    show._going.on.value, show._going.within.value = True, wrong
    show._draw_at((1.0, 5.0, 2.0), (0.0, -1.0, 0.0))
    run(show, 1)
    assert not [heard for heard in actors[0].heard if heard[0] == "go"]
