"""`mapctl measure --why`: what tells two folders apart, as JSON, as tables and as a picture; and what is refused."""

import json

import pytest
from helpers import run, walk

from mapctl.commands.measure import clip_sets
from mapctl.metrics import realism
from mapctl.metrics.realism import ClassifierSettings
from mapctl.metrics.realism.evidence.parts import BANDS, JOINTS
from mapctl.skeleton import CANONICAL


@pytest.fixture(autouse=True)
def quick(monkeypatch):
    """A small network."""
    small = ClassifierSettings(folds=2, steps=5, width=8, batch=32, learning_rate=3e-3)
    monkeypatch.setattr(clip_sets, "SETTINGS", realism.RealismSettings(classifier=small))


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    """Walks, the same with the head bent, and the same once more."""
    base = tmp_path_factory.mktemp("why")
    for name in ("mocap", "bent", "same"):
        (base / name).mkdir()
        for k in range(6):
            clip = walk(62, cadence=0.8 + 0.05 * k)
            if name == "bent":
                bend = clip.local_quat_xyzw[:, CANONICAL.index("neck")]
                bend[:] = bend.new_tensor([0.39, 0.0, 0.0, 0.92])
            clip.save(base / name / f"{k}.npz")
    return base


def words(folders, name, *more):
    return ["measure", folders / name, "--reference", folders / "mocap", "--why", *more]


@pytest.mark.slow
def test_a_bent_head_is_named_with_clips_to_look_at(folders, capsys):
    picture = folders / "why.png"
    assert run(*words(folders, "bent", "--steps", 60, "-o", picture), "--json") == 0
    values = json.loads(capsys.readouterr().out)
    why = values["why"]
    assert (why["steps"], why["told_apart"]) == (60, True)
    assert why["accuracy"] == values["realism"]["accuracy"] > 0.9
    assert {row["name"] for row in why["joints"]} == set(JOINTS)
    assert (why["joints"][0]["name"], why["joints"][0]["named"]) == ("head", True)
    assert (why["bands"][0]["name"], why["bands"][0]["alone"]) == ("mean pose", None)
    assert sum(row["share"] for row in why["joints"]) == pytest.approx(1)
    moment = why["moments"][0]
    assert moment["clip"] in {f"{k}.npz" for k in range(6)}
    assert (moment["joint"], moment["band"], moment["gait"]) == ("head", "mean pose", "walk")
    assert 0 < moment["seconds"] < 62 / 30
    assert picture.read_bytes().startswith(b"\x89PNG")


@pytest.mark.slow
def test_tables_name_what_is_more_than_chance(folders, capsys):
    assert run(*words(folders, "bent", "--steps", 60)) == 0
    told = capsys.readouterr().out
    assert "why: after 60 steps told apart in" in told
    joints = told[told.index("joint, from the one above it") : told.index("by gait")]
    assert "head" in joints
    assert "leftFoot" not in joints
    assert "look at " in told
    assert "head, mean pose (" in told


@pytest.mark.slow
def test_no_cause_is_named_where_sets_are_alike(folders, capsys):
    assert run(*words(folders, "same", "--steps", 5)) == 0
    told = capsys.readouterr().out
    assert "not above the floor, so no cause is named" in told
    assert "look at " not in told
    assert not any(band in told for band in BANDS)


@pytest.mark.slow
def test_steps_decide_how_strict_the_judge_is(folders, capsys):
    found = []
    for steps in (2, 60):
        assert run("measure", folders / "bent", "--reference", folders / "mocap", "--steps", steps, "--json") == 0
        found.append(json.loads(capsys.readouterr().out))
    assert "why" not in found[0]
    assert found[0]["realism"]["accuracy"] < found[1]["realism"]["accuracy"]


@pytest.mark.slow
def test_what_groups_tell_alone_is_asked_for(folders, capsys, monkeypatch):
    monkeypatch.setattr(clip_sets, "SETTINGS", realism.RealismSettings(classifier=ClassifierSettings(2, 40, 32, 8)))
    assert run(*words(folders, "bent", "--steps", 60, "--alone", "--json")) == 0
    why = json.loads(capsys.readouterr().out)["why"]
    joints = {row["name"]: row["alone"] for row in why["joints"]}
    assert min(joints["head"], why["regions"]["trunk and head"]) > 0.9
    assert max(joints["leftHand"], why["regions"]["legs"]) < 0.8
    assert run(*words(folders, "bent", "--steps", 60, "--alone")) == 0
    told = capsys.readouterr().out
    assert "region alone" in told
    assert "feet over the ground" in told


@pytest.mark.parametrize(
    ("more", "said"),
    [
        (["--why"], "are about two folders that are compared"),
        (["--steps", 9], "are about two folders that are compared"),
        (["--reference", "mocap", "--why", "--steps", 0], "--steps must be at least 1, got 0"),
        (["--reference", "mocap", "--alone"], "--out and --alone are about --why"),
        (["--reference", "mocap", "-o", "why.png"], "--out and --alone are about --why"),
        (["--reference", "mocap", "--why", "-o", "why.jpg"], "--out writes .png, not .jpg"),
        (["--reference", "mocap", "--why", "-o", "nowhere/why.png"], "nowhere"),
    ],
    ids=str,
)
def test_what_cannot_be_is_refused(folders, monkeypatch, fails, more, said):
    monkeypatch.chdir(folders)
    assert said in fails("measure", "bent", *more)
