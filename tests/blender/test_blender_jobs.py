"""The add-on in Blender: each operator, on armatures of several kinds, gives the joints that the command line gives."""

import numpy as np
import pytest
from blender_session import needs_blender, run_in_blender
from tiny_denoiser import save_tiny_denoiser
from tiny_infiller import save_tiny_infiller
from tiny_prior import save_tiny_prior

import mapctl
from mapctl.commands.blender_addon import build_addon_zip

pytestmark = [needs_blender, pytest.mark.slow]

CLOSE = 2e-5  # metres: Blender's single precision
HEIGHT = 0.25  # metres of the curve over the ground
WRITTEN = {"clean": "denoise", "filled": "infill", "tweened": "tween", "again": "tween"}
"""Commands of the stages after the walk; of two that ran the same, the later one's files are left."""
KINDS = [
    pytest.param(("imported", True, 24, 5), id="imported"),
    pytest.param(("generated", True, 30, 4), id="generated"),
    pytest.param(("metarig", False, 24, 5), id="metarig"),
]


@pytest.fixture(scope="module", params=KINDS)
def played(request, tmp_path_factory):
    """Facts noted in Blender after every operator, and the folder with the files that were exchanged."""
    kind, small, fps, stages = request.param
    folder = tmp_path_factory.mktemp("blender")
    (folder / "kept").mkdir()
    (folder / "addon.zip").write_bytes(build_addon_zip())
    save_tiny_prior(folder / "prior.safetensors")
    save_tiny_denoiser(folder / "denoiser.safetensors", drawn=0.02)
    save_tiny_infiller(folder / "infiller.safetensors", drawn=0.02)
    facts, arrays = run_in_blender("play_jobs.py", folder, kind, folder if small else "-", fps, stages)
    return kind, fps, folder / "kept", facts, arrays


def last_stages(facts) -> dict[str, str]:
    """The stage whose files are left, by command."""
    return {command: stage for stage, command in WRITTEN.items() if stage in facts["stages"]}


def joints(file, names) -> np.ndarray:
    """World positions of a motion file's joints, by name."""
    motion = mapctl.load(file)
    order = [motion.skeleton.names.index(name) for name in names if name in motion.skeleton.names]
    return motion.joint_positions()[:, order].numpy()


def shown(arrays, stage, names, file) -> np.ndarray:
    """World positions in Blender of the joints of a motion file."""
    own = mapctl.load(file).skeleton.names
    return arrays[stage][:, [position for position, name in enumerate(names) if name in own]]


def test_each_operator_ends_well(played):
    *_, facts, _ = played
    assert list(facts["stages"])[:4] == ["walk", "clean", "filled", "tweened"]
    assert {tuple(stage["status"]) for stage in facts["stages"].values()} == {("FINISHED",)}
    for stage in facts["stages"].values():
        assert not [line for line in stage["printed"] if " off: " in line]


def test_the_walk_is_the_one_of_the_command_line(played):
    _, fps, kept, facts, arrays = played
    file = kept / "follow" / "walk.npz"
    wanted = joints(file, facts["joints"]) + np.array([0, HEIGHT, 0])
    assert np.abs(shown(arrays, "walk", facts["joints"], file) - wanted).max() < CLOSE
    assert mapctl.load(file).fps == fps


def test_the_walk_is_on_the_curve(played):
    _, _, kept, facts, arrays = played
    points = np.loadtxt(kept / "follow" / "curve.csv", delimiter=",", skiprows=1)
    hips = arrays["walk"][:, 0]
    assert np.linalg.norm(hips[0, ::2] - points[0]) < 0.01
    apart = np.linalg.norm(hips[:, None, ::2] - points, axis=-1).min(axis=1)
    assert apart.max() < 0.2
    left, right = (next(k for k, n in enumerate(facts["joints"]) if n in names) for names in LEGS)
    across = (arrays["walk"][0, left] - arrays["walk"][0, right])[::2]
    ahead = points[3] - points[0]
    assert across @ (ahead[1], -ahead[0]) > 0.9 * np.linalg.norm(across) * np.linalg.norm(ahead), "left is left"


LEGS = [(f"mixamorig:{side}UpLeg", f"thigh.{side[0]}", f"DEF-thigh.{side[0]}") for side in ("Left", "Right")]


def test_what_is_sent_is_what_blender_shows(played):
    _, _, kept, facts, arrays = played
    for command, stage in last_stages(facts).items():
        file = kept / command / "given.npz"
        sent = joints(file, facts["joints"])[:25]
        assert np.abs(shown(arrays, f"{stage} before", facts["joints"], file) - sent).max() < CLOSE


def test_what_comes_back_is_what_blender_shows(played):
    _, _, kept, facts, arrays = played
    for command, stage in last_stages(facts).items():
        file = kept / command / "result.npz"
        result = joints(file, facts["joints"])
        assert np.abs(shown(arrays, stage, facts["joints"], file)[: len(result)] - result).max() < CLOSE


def test_outside_of_a_gap_nothing_moves(played):
    *_, arrays = played
    before, after = arrays["filled before"], arrays["filled"][:25]
    moved = np.abs(after - before).max(axis=(1, 2))
    assert moved[:9].max() < CLOSE
    assert moved[18:].max() < CLOSE
    assert moved[9:18].max() > 0.001


def test_keys_stay_and_frames_between_are_generated(played):
    _, _, kept, facts, arrays = played
    assert (kept / "tween" / "words.txt").read_text().split("\n")[4:6] == ["--keyframes", "0,8,16,24"]
    for stage in {"tweened", "again"} & facts["stages"].keys():
        moved = np.abs(arrays[stage][:25] - arrays[f"{stage} before"]).max(axis=(1, 2))
        assert moved[[0, 8, 16, 24]].max() < CLOSE
        assert facts["stages"][stage]["own keys"] == [1, 9, 17, 25], "generated keys are no keys the next time"
    assert np.abs(arrays["tweened"][:25] - arrays["tweened before"]).max() > 0.001


def test_actions_are_new_and_the_old_ones_are_kept(played):
    *_, facts, _ = played
    names = [stage["action"] for stage in facts["stages"].values()]
    assert len(set(names)) == len(names)
    kept = dict(facts["actions"])
    assert [kept[name] for name in names] == [*[True] * (len(names) - 1), False]
    assert names[1] == f"{names[0]} clean"


def test_scene_is_as_it_was_but_long_enough(played):
    *_, facts, arrays = played
    assert facts["frame"] == 7
    assert facts["end"] == len(arrays["walk"]) == pytest.approx(26, abs=1)
    assert facts["left behind"] == [1, 0]


def test_curves_have_no_jumps(played):
    *_, facts, _ = played
    for stage in facts["stages"].values():
        assert stage["steps"].get("rotation_quaternion", 0) < 1
        assert stage["steps"].get("rotation_axis_angle", 0) < 1.42, (
            "axes may swing where angles are small, not turn over"
        )
        assert stage["steps"].get("rotation_euler", 0) < 3, "angles may run fast near gimbal lock, but not wrap"
        assert stage["linear"]


def test_only_the_root_and_bones_that_travel_have_places(played):
    kind, _, _, facts, _ = played
    roots = {"imported": ["mixamorig:Hips"]}
    wanted = roots.get(kind, ["torso"] if "generated" in kind else ["spine"])
    assert {tuple(stage["placed"]) for stage in facts["stages"].values()} == {tuple(wanted)}


def test_generated_rigs_are_keyed_by_their_fk_controls(played):
    kind, _, kept, facts, _ = played
    if "generated" not in kind:
        assert facts["switches"] == []
        return
    bones = set(facts["stages"]["walk"]["bones"])
    assert {"torso", "upper_arm_fk.L", "thigh_fk.R", "foot_fk.L", "toe_fk.R", "shoulder.L", "head"} <= bones
    assert not [name for name in bones if name.startswith(("DEF-", "ORG-", "MCH-"))]
    assert facts["switches"] == [1.0] * 4
    assert 'leftUpperLeg = "DEF-thigh.L"' in (kept / "denoise" / "rigify.toml").read_text()
