"""Scene files: the ready ones load, and whatever is wrong is said in one line with file and key."""

from pathlib import Path

import numpy as np
import pytest

import scenes
from mapctl import curves
from mapctl.errors import FileFormatError, RequestError
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
    "not text": (b"\xff\xfe\x00", "UTF-8"),
    "empty": ("", "the file is empty"),
    "no actors": (OUT + "actors = []", "actors: "),
    "no outputs": (ACTOR, "outputs: this key is needed"),
    "unknown key": (OUT + "colour = 'red'\n" + ACTOR, "colour: there is no such key; allowed: actors,"),
    "unknown actor key": (OUT + ACTOR + "vel = 2", "actors[0].vel: there is no such key; allowed: curve,"),
    "unknown camera key": (OUT + ACTOR + "[camera]\nlens = 3", "camera.lens: there is no such key; allowed: kind,"),
    "speed is text": (OUT + ACTOR + "speed = 'fast'", "actors[0].speed: a speed is a number or ARC:SPEED"),
    "seed is a fraction": (OUT + ACTOR + "seed = 1.5", "actors[0].seed: "),
    "negative speed": (OUT + ACTOR + "speed = -1", "actors[0].speed: input should be greater than 0, got -1"),
    "not a number": (OUT + ACTOR + "seconds = nan", "actors[0].seconds: "),
    "infinite": (OUT + ACTOR + "start_seconds = inf", "actors[0].start_seconds: "),
    "one coordinate": (OUT + ACTOR + "offset = [1]", "actors[0].offset"),
    "second actor": (OUT + ACTOR + ACTOR + "seconds = 0", "actors[1].seconds: "),
    "colour": (OUT + ACTOR + "colour = 'reddish'", "actors[0].colour: colour must be #rrggbb or one of"),
    "same name": (OUT + (ACTOR + "name = 'a'\n") * 2, "actors[1].name: 'a' is taken"),
    "name with a slash": (OUT + ACTOR + "name = 'a/b'", "actors[0].name: "),
    "camera kind": (OUT + ACTOR + "[camera]\nkind = 'side'", "camera.kind: input should be 'fixed', 'follow' or 'top'"),
    "camera below ground": (OUT + ACTOR + "[camera]\nelevation_deg = -5", "camera: the camera's elevation_deg must be"),
    "ending": ("outputs = ['a.avi']\n" + ACTOR, "outputs[0]: 'a.avi' must end in one of .mp4"),
    "folder": ("outputs = ['../a.mp4']\n" + ACTOR, "outputs[0]: "),
    "twice": ("outputs = ['a.mp4', 'a.mp4']\n" + ACTOR, "outputs[1]: "),
    "tiny picture": (OUT + "size = [4, 4]\n" + ACTOR, "size[0]: "),
    "no such shape": (OUT + "[[actors]]\ncurve = 'blob:3'", "actors[0].curve: "),
    "no such curve file": (OUT + "[[actors]]\ncurve = 'gone.csv'", "actors[0].curve: "),
    "zero radius": (OUT + "[[actors]]\ncurve = 'circle:0'", "actors[0].curve: "),
    "speeds by arc": (OUT + ACTOR + "speed = '0:1,0:2'", "actors[0].speed: the arcs of a speed profile must rise"),
    "two speeds": (OUT + ACTOR + "speed = 1\nspeed_by_time = [[0, 1]]\nseconds = 2", "actors[0].speed_by_time: "),
    "no duration": (OUT + ACTOR + "speed_by_time = [[0, 1]]", "actors[0].seconds: this key is needed with speed_by"),
    "no curve, no duration": (OUT + "[[actors]]\nstart = 'stand'", "actors[0].seconds: this key is needed"),
    "speed below zero": (OUT + ACTOR + "speed_by_time = [[0, -1]]", "actors[0].speed_by_time[0][1]: "),
    "start": (OUT + ACTOR + "start = 'sit'", "actors[0].start: expected walk, stand or CLIP:FRAME, got 'sit'"),
    "end": (OUT + ACTOR + "end = 'sit'", "actors[0].end: expected walk, stand or CLIP:FRAME, got 'sit'"),
    "unknown key of a key": (
        OUT + ACTOR + "[[actors.keys]]\nsecond = 1",
        "actors[0].keys[0].second: there is no such key; ",
    ),
    "key without a time": (OUT + ACTOR + "[[actors.keys]]\nlook_at = [0, 1, 2]", "actors[0].keys[0]"),
    "key without a wish": (OUT + ACTOR + "[[actors.keys]]\nseconds = 1", "actors[0].keys[0]"),
    "no obstacle": (OUT + ACTOR + "[[obstacles]]\nplace = [0, 1]\nradius = -1", "obstacles[0].radius: "),
    "disc and box": (OUT + ACTOR + "[[obstacles]]\nplace = [0, 1]\nradius = 1\nsize = [1, 1]", "obstacles[0].radius: "),
    "a head that reaches": (
        OUT + ACTOR + "[[actors.keys]]\nseconds = 1\nreach = { head = [0, 1, 2] }",
        "actors[0].keys[0].reach.head: hands and feet are leftHand",
    ),
    "unknown obstacle key": (OUT + ACTOR + "[[obstacles]]\nplace = [0, 1]\nr = 1", "obstacles[0].r: there is no such"),
    "date": (OUT + ACTOR + "speed = 2020-01-01", "actors[0].speed: "),
}


@pytest.mark.parametrize("case", WRONG)
def test_what_is_wrong_is_said_in_one_line_with_file_and_key(case, tmp_path):
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


def test_a_missing_scene_is_a_format_error(tmp_path):
    with pytest.raises(FileFormatError, match="no such file"):
        load(tmp_path / "gone.toml")


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


def test_place_keeps_the_height_of_curves_in_space(tmp_path):
    (tmp_path / "stairs.csv").write_text("x,y,z\n0,0,0\n0,1,2\n1,2,3\n")
    flat, space = (
        curves.read(tmp_path / "stairs.csv"),
        transform_curve(Actor(curve="stairs.csv", turn_deg=90.0), tmp_path),
    )
    assert space.points[:, 1].numpy() == pytest.approx(flat.points[:, 1].numpy())
    assert space.points[:, 0].numpy() == pytest.approx(flat.points[:, 2].numpy())
    assert space.length == pytest.approx(flat.length)


def test_curve_files_are_relative_to_the_scene(tmp_path):
    folder = tmp_path / "deep"
    folder.mkdir()
    (folder / "way.csv").write_text("0,0\n0,1\n1,2\n")
    (folder / "scene.toml").write_text(OUT + "[[actors]]\ncurve = 'way.csv'")
    _, (curve,) = load(folder / "scene.toml")
    assert curve.length == pytest.approx(1 + np.sqrt(2), rel=1e-3)


def test_at_least_three_ready_scenes_load_and_one_has_five_actors():
    loaded = {name: load(scenes.find_scene(name))[0] for name in scenes.list_scenes()}
    assert len(loaded) >= 3
    assert max(len(scene.actors) for scene in loaded.values()) >= 5
    for scene in loaded.values():
        assert scene.films(".")
        assert len({actor.colour for actor in scene.actors}) == len(scene.actors)


def test_crossing_actors_keep_out_of_each_others_way():
    scene, ways = load(scenes.find_scene("crossing"))
    time = np.arange(0, 14, 0.05)
    places = []
    for actor, way in zip(scene.actors, ways, strict=True):
        arcs = np.clip((time - actor.start_seconds) * actor.speed, 0, way.length)
        places.append(np.stack([way.point(float(arc)).numpy() for arc in arcs]))
    apart = [np.linalg.norm(a - b, axis=1).min() for k, a in enumerate(places) for b in places[:k]]
    assert min(apart) > 0.7


def test_unknown_scenes_are_refused_with_the_ready_ones():
    with pytest.raises(RequestError, match="figure_eight"):
        scenes.find_scene("waltz")
