"""Scene files: the ready ones load, and whatever is wrong is said in one line with file and key."""

from pathlib import Path

import numpy as np
import pytest

import scenes
from mapctl.errors import FileFormatError
from scenes.scene_file import Actor, load, transform_curve

GOOD = """
outputs = ["walk.mp4", "walk.bvh", "walk.json"]
[[actors]]
curve = "circle:4"
"""
ACTOR = "[[actors]]\ncurve = 'line:3'\n"
OUT = "outputs = ['a.mp4']\n"

WRONG = {
    "not TOML": ("actors = [", "not TOML"),
    "empty": ("", "the file is empty"),
    "no outputs": (ACTOR, "outputs: this key is needed"),
    "unknown key": (OUT + "colour = 'red'\n" + ACTOR, "colour: there is no such key; allowed: actors,"),
    "unknown actor key": (OUT + ACTOR + "vel = 2", "actors[0].vel: there is no such key; allowed: speed,"),
    "speed is text": (OUT + ACTOR + "speed = 'fast'", "actors[0].speed: a speed is a number or ARC:SPEED"),
    "negative speed": (OUT + ACTOR + "speed = -1", "actors[0].speed: input should be greater than 0, got -1"),
    "colour": (OUT + ACTOR + "colour = 'reddish'", "actors[0].colour: colour must be #rrggbb or one of"),
    "same name": (OUT + (ACTOR + "name = 'a'\n") * 2, "actors[1].name: 'a' is taken"),
    "camera kind": (OUT + ACTOR + "[camera]\nkind = 'side'", "camera.kind: input should be 'fixed', 'follow' or 'top'"),
    "ending": ("outputs = ['a.avi']\n" + ACTOR, "outputs[0]: 'a.avi' must end in one of .mp4"),
    "folder": ("outputs = ['../a.mp4']\n" + ACTOR, "outputs[0]: "),
    "no such curve file": (OUT + "[[actors]]\ncurve = 'gone.csv'", "actors[0].curve: "),
    "two speeds": (OUT + ACTOR + "speed = 1\nspeed_by_time = [[0, 1]]\nseconds = 2", "actors[0].speed_by_time: "),
    "no duration": (OUT + ACTOR + "speed_by_time = [[0, 1]]", "actors[0].seconds: this key is needed with speed_by"),
    "start": (OUT + ACTOR + "start = 'sit'", "actors[0].start: expected walk, stand or CLIP:FRAME, got 'sit'"),
    "key without a time": (OUT + ACTOR + "[[actors.keys]]\nlook_at = [0, 1, 2]", "actors[0].keys[0]"),
    "disc and box": (
        OUT + ACTOR + "[[obstacles]]\nplace = [0, 1]\nradius = 1\nsize = [1, 1]",
        "an obstacle at 0, 1 has a radius or a size",
    ),
    "a head that reaches": (
        OUT + ACTOR + "[[actors.keys]]\nseconds = 1\nreach = { head = [0, 1, 2] }",
        "actors[0].keys[0].reach.head: hands and feet are leftHand",
    ),
}


@pytest.mark.parametrize("case", WRONG)
def test_faults_are_reported_in_one_line_with_file_and_key(case, tmp_path):
    text, words = WRONG[case]
    path = tmp_path / "scene.toml"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    with pytest.raises(FileFormatError) as caught:
        load(path)
    message = str(caught.value)
    assert message.startswith(f"{path}: ")
    assert words in message
    assert "\n" not in message
    assert len(message) < 400 + len(str(path)) * 2


def test_defaults_and_paths(tmp_path):
    path = tmp_path / "scene.toml"
    path.write_text(GOOD)
    scene, (curve,) = load(path)
    assert (scene.actors[0].name, scene.size, scene.camera.kind) == ("actor1", (1280, 720), "fixed")
    assert curve.closed
    assert curve.length == pytest.approx(8 * np.pi, rel=1e-3)
    assert scene.films("out") == [Path("out/walk.mp4")]
    assert [str(p) for p in scene.motions("out")["actor1"]] == ["out/walk.bvh"]
    assert [str(p) for p in scene.reports("out")] == ["out/walk.json"]


def test_several_actors_write_a_motion_each(tmp_path):
    path = tmp_path / "scene.toml"
    path.write_text(GOOD + ACTOR)
    scene, _ = load(path)
    names = [str(p) for paths in scene.motions(".").values() for p in paths]
    assert names == ["walk-actor1.bvh", "walk-actor2.bvh"]


@pytest.mark.parametrize("turn", [0.0, 90.0, -135.0])
def test_place_turns_about_the_origin_and_then_moves(turn, tmp_path):
    actor = Actor(curve="line:3", offset=(2.0, -1.0), turn_deg=turn)
    curve = transform_curve(actor, tmp_path)
    heading = np.radians(turn)
    assert curve.start.numpy() == pytest.approx([2.0, -1.0])
    end = np.array([2.0, -1.0]) + 3 * np.array([np.sin(heading), np.cos(heading)])
    assert curve.points[-1].numpy() == pytest.approx(end)
    assert np.radians(turn) == pytest.approx(curve.start_heading, abs=1e-6)


def test_at_least_three_ready_scenes_load_and_one_has_five_actors():
    loaded = {name: load(scenes.find_scene(name))[0] for name in scenes.list_scenes()}
    assert len(loaded) >= 3
    assert max(len(scene.actors) for scene in loaded.values()) >= 5
    for scene in loaded.values():
        assert scene.films(".")
        assert len({actor.colour for actor in scene.actors}) == len(scene.actors)
