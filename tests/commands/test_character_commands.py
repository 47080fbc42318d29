"""--character as a user types it: which films show a character, what stays as it is without it, and refusals."""

from importlib.util import find_spec

import numpy as np
import pytest
from character_maker import make_character_glb
from glb_builder import pack_glb
from helpers import run, walk

from scenes.stage import Stage

pytestmark = pytest.mark.skipif(any(find_spec(name) is None for name in ("PIL", "av")), reason="needs mapctl[render]")


@pytest.fixture
def hero(tmp_path):
    return make_character_glb(tmp_path / "hero.glb").path


@pytest.fixture
def staged(monkeypatch) -> list[Stage]:
    """The stages of all films."""
    found, plain = [], Stage.__init__

    def noted(stage, *words, **named):
        plain(stage, *words, **named)
        found.append(stage)

    monkeypatch.setattr(Stage, "__init__", noted)
    monkeypatch.setenv("MAPCTL_RENDERER", "stick")  # quick, and needs no OpenGL
    return found


def draws_own_mesh(stages: list[Stage]) -> list[list[bool]]:
    """By stage and actor whether a file's mesh is drawn, which was read with all frames aligned."""
    return [[player.body.mesh.frames is None for player in stage.players] for stage in stages]


@pytest.mark.slow
def test_render_shows_it_and_a_mannequin_without(hero, staged, tmp_path, caplog):
    walk(12).save(tmp_path / "walk.bvh")
    words = ("-o", tmp_path / "x.png", "--size", "96x64")
    assert run("render", tmp_path / "walk.bvh", *words, "--character", hero) == 0
    assert [record.message for record in caplog.records] == [
        "stick figures show no mesh: characters are drawn by their bones"
    ]
    caplog.clear()
    assert run("render", tmp_path / "walk.bvh", *words) == 0
    assert caplog.records == []
    assert draws_own_mesh(staged) == [[True], [False]]


@pytest.mark.slow
def test_render_takes_a_characters_own_motion_as_it_is(staged, tmp_path):
    result = make_character_glb(tmp_path / "two.glb", animations=("walk", "run"), frames=13)
    out = tmp_path / "x.png"
    for choice in ("", "#/run", "#Armature_skin/run"):
        source = f"{result.path}{choice}"
        assert run("render", source, "-o", out, "--character", result.path, "--size", "96x64", "--quiet") == 0
    first, *others = [stage.players[0].body.surface(7).vertices for stage in staged]
    assert np.abs(first - others[0]).max() > 0.02, "another animation"
    np.testing.assert_array_equal(*others)


SCENE = """prior = '{prior}'
outputs = [{outputs}]
size = [96, 64]
actors = [
    {{curve = 'line:2', seconds = 1, name = 'ann'}},
    {{curve = 'line:2', seconds = 1, offset = [1, 0], name = 'bob', character = 'own/child.glb'}},
]
"""


@pytest.mark.slow
def test_scenes_give_characters_by_actor(prior, staged, tmp_path):
    (tmp_path / "own").mkdir()
    make_character_glb(tmp_path / "own" / "child.glb", size=0.6)
    scene = tmp_path / "scene.toml"
    scene.write_text(SCENE.format(prior=prior, outputs="'x.png'"))
    assert run("run", scene, "-o", tmp_path / "out", "--quiet") == 0
    assert draws_own_mesh(staged) == [[False, True]]


def write_broken(folder):
    """By what is wrong: a file, and what is said of it."""
    walk(12).save(folder / "walk.bvh")
    (folder / "bare.glb").write_bytes(pack_glb({"asset": {"version": "2.0"}}, b""))
    (folder / "text.glb").write_text("no glTF")
    make_character_glb(folder / "hero.glb")
    return {
        "missing.glb": "missing.glb: no such file",
        "walk.bvh": "walk.bvh: is no character's file; those end as",
        "bare.glb": "bare.glb: has no skin",
        "text.glb": "text.glb: is no binary glTF",
        "hero.glb#Other": "hero.glb: has no armature 'Other'; it has 'Armature_skin'",
    }


@pytest.mark.slow
def test_what_is_no_character_is_one_line_and_nothing_is_written(prior, tmp_path, fails, monkeypatch):
    monkeypatch.setenv("MAPCTL_RENDERER", "stick")
    for file, said in write_broken(tmp_path).items():
        (tmp_path / "scene.toml").write_text(
            f"prior = '{prior}'\noutputs = ['x.png']\n[[actors]]\ncurve = 'line:2'\ncharacter = '{file}'\n"
        )
        assert said in fails("render", "walk.bvh", "-o", "x.png", "--character", file), file
        assert said in fails("run", "scene.toml", "-o", "out")
        assert said in fails("live", "--prior", prior, "--character", file)
