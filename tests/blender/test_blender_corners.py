"""The add-on in Blender: any armature comes back as it was, errors are reported, undo leaves no trace."""

import numpy as np
import pytest
from blender_session import needs_blender, run_in_blender

import mapctl
from mapctl.commands.blender_addon import build_addon_zip

pytestmark = needs_blender

CLOSE = 2e-6  # metres


@pytest.fixture(scope="module")
def facts(tmp_path_factory) -> dict:
    """Facts noted in Blender."""
    folder = tmp_path_factory.mktemp("corners")
    (folder / "addon.zip").write_bytes(build_addon_zip())
    found, walked = run_in_blender("play_corners.py", folder)
    return found | {"walked": walked, "folder": folder}


@pytest.mark.parametrize(
    "kind",
    ["imported", "object that is animated too", "scene in centimetres", "bones that do not follow", "bones that spin"],
)
def test_armatures_come_back_as_they_were(facts, kind):
    assert facts["apart"][kind] < CLOSE


def test_mapctl_gets_metres(facts):
    assert facts["thigh"] == pytest.approx(0.42, abs=0.01)


def test_other_curves_stay(facts):
    root = 'pose.bones["mixamorig:Hips"]'
    assert facts["other curves"] == ["location", f"{root}.location", f'{root}["mood"]']


def test_bones_that_travel_keep_their_places(facts):
    assert not facts["connected"]
    assert facts["travelling"] == ["mixamorig:Hips", "mixamorig:LeftUpLeg"]


def test_an_effector_kept_off_its_target_by_constraints_is_reported(facts):
    assert facts["apart"]["arm that is stretched"] < CLOSE, "constraints still hold"
    assert "mixamorig:Left" in facts["stretched printed"][0]
    assert " cm off: constraints" in facts["stretched printed"][0]
    assert facts["stretched printed"][1:] == ["frame 0 in mapctl's lines is frame 1 of the scene", "echoed"]


def test_rigs_animated_by_ik_keep_hands_and_feet_where_they_were(facts):
    assert facts["apart"]["hands and feet by IK"] < 2e-4
    assert facts["apart"]["generated rig by IK"] < 0.03, "elbows and knees: limbs are no longer squeezed"
    assert facts["turned"] < 1e-3
    assert facts["stretch is back"] == pytest.approx(0.1)


def test_walk_is_asked_for_as_the_options_say(facts):
    words = ["follow", "curve.csv", "--rig", "character.npz", "-o", "walk.npz", "--fps", "30"]
    requests = ["--seed", "3", "--speed", "1.5", "--seconds", "2.5", "--style", "proud"]
    assert facts["words"] == words + requests


def test_curves_are_sampled_in_the_world(facts):
    points = np.array([line.split(",") for line in facts["curve"].split()[1:]], dtype=float)
    assert facts["curve"].startswith("x,z\n")
    assert points[0].tolist() == points[-1].tolist(), "a cyclic curve ends where it begins"
    assert len(points) == 2 * 12 + 1, "two segments of the curve alone, not of its bevel"
    for knot in facts["knots"]:
        assert np.linalg.norm(points - knot, axis=1).min() < 1e-5


def test_walk_begins_where_the_preview_does_and_is_the_worlds(facts):
    assert facts["range"] == [5.0, 16.0]
    wanted = mapctl.load(facts["folder"] / "mixamo.npz").root_position.numpy() + np.array([0, 0.4, 0])
    assert np.abs(np.array(facts["root"]) - wanted).max() < CLOSE


@pytest.mark.parametrize(("kind", "file", "height"), [("imported", "mixamo", 0.4), ("generated", "rig", 0.0)])
def test_walks_start_from_a_clean_pose(facts, kind, file, height):
    wanted = mapctl.load(facts["folder"] / f"{file}.npz").joint_positions().numpy() + np.array([0, height, 0])
    assert np.abs(facts["walked"][kind] - wanted).max() < 1e-5


def test_curves_off_the_floor_are_reported_and_the_scene_is_long_enough(facts):
    printed, end = facts["not level"]
    assert printed.endswith("is not level: the character walks at its median height")
    assert end == 12


def test_angles_do_not_wrap(facts):
    assert len(facts["spin"]) > 20
    assert max(facts["spin"]) < 1.0


def test_jobs_that_end_early_leave_no_trace(facts):
    assert facts["ended early"] == ["changed, then as before"] * 2
    assert facts["walk ended early"] == "as before"


def test_all_is_undone_in_one_step(facts):
    assert facts["undone"] == [True, ["holderAction"], 1]


ERRORS = {
    "program that is not there": "/nowhere/mapctl: no such program",
    "program that is old": "mapctl 0.0.9 is too old",
    "no curve": "select the armature and one curve",
    "curve of two splines": "has 2 splines",
    "no action": "mixamo has no action",
    "keys in every frame": "every frame from 3 to 4 has keys",
    "gap that is outside": "the gap 8 to 13 is not within the action's frames 1 to 12",
    "rest position": "shows its rest position",
    "uneven scale": "mixamo is scaled unevenly",
    "mirrored": "mixamo is mirrored by a negative scale",
    "mapctl's own": "nobody walks here",
    "mapctl that crashes": "Segmentation fault",
}


def test_errors_are_shown_and_nothing_is_changed(facts):
    assert facts["errors"].keys() == ERRORS.keys()
    for name, (printed, changed) in facts["errors"].items():
        assert ERRORS[name] in printed
        assert changed == "unchanged"


def test_selected_bones_alone_are_filled(facts):
    assert facts["gap words"][4:] == ["--gap", "3:7", "--joints", "mixamorig:LeftArm,mixamorig:LeftHand"]
