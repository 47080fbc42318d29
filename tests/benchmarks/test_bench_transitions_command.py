"""`mapctl bench transitions` as a user types it."""

import json
from dataclasses import replace

import pytest
import tiny_stitcher
import tiny_transformer
from helpers import run, walk
from tiny_infiller import save_tiny_infiller
from tiny_prior import save_tiny_prior

from mapctl import retarget
from priors import checkpoints

LONG = replace(tiny_stitcher.CONFIG, longest=61)
HELD_OUT = {"validation": ["bandai/a_walk_0.bvh"], "test": ["bandai/a_walk_1.bvh"]}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Clips of which training did not see two, and a transformer whose card says so."""
    path = tmp_path_factory.mktemp("transitions")
    for number in range(5):
        motion = walk(80, turn_rate=0.3 * number, seed=number)
        clip = path / "data" / "bandai" / f"a_walk_{number}.bvh"
        clip.parent.mkdir(parents=True, exist_ok=True)
        retarget.from_canonical(motion, retarget.identify_rig(motion.skeleton)).save(clip)
    card = replace(tiny_transformer.card(), data={"held_out": HELD_OUT})
    checkpoints.save(tiny_transformer.network(drawn=0.05).state_dict(), card, path / "ours.safetensors")
    save_tiny_infiller(path / "other.safetensors", drawn=0.1)
    return path


def measure(folder, capsys, *words):
    asked = ["--data", folder / "data", "--inbetweener", folder / "ours.safetensors", "--json", *words]
    assert run("bench", "transitions", *asked) == 0
    return json.loads(capsys.readouterr().out)["rows"]


@pytest.mark.slow
@pytest.mark.parametrize("past", ["1", "10", "all"])
def test_rows_of_methods_kinds_and_lengths_on_unseen_clips(folder, capsys, past):
    rows = measure(folder, capsys, "--past", past, "--raw", "--baselines", folder / "other.safetensors")
    methods = {"mocap", "zero velocity", "slerp", "retrieval"}
    methods |= {f"{folder / name}.safetensors, raw" for name in ("ours", "other")}
    assert {row["method"] for row in rows} == methods
    assert {row["frames"] for row in rows} == {5, 15, 30, 45}
    assert all(row["windows"] == 2 for row in rows)  # one of 65 frames in each of two clips
    ours = {row["frames"]: row for row in rows if row["method"].startswith(str(folder / "ours"))}
    assert all(row["ade_cm"] > 0.1 and row["frame_ms"] > 0 for row in ours.values())


@pytest.mark.slow
def test_finished_rows_and_auto_if_asked(folder, capsys):
    rows = measure(folder, capsys, "--auto")
    methods = {row["method"] for row in rows}
    assert {"auto", f"{folder / 'ours.safetensors'}, finished"} <= methods


@pytest.mark.slow
def test_a_stitcher_has_rows_of_its_calm_answer_and_its_draws(folder, capsys):
    network, card = tiny_stitcher.network(config=LONG), replace(tiny_stitcher.card(LONG), data={"held_out": HELD_OUT})
    checkpoints.save(network.state_dict(), card, folder / "stitch.safetensors")
    name = str(folder / "stitch.safetensors")
    rows = measure(folder, capsys, "--past", "1", "--raw", "--stitcher", name)
    methods = {f"{name}, calm, raw"} | {
        f"{each}, {which}" for each in (name, "retrieval") for which in ("one draw", "best of 8 by truth")
    }
    assert methods < {row["method"] for row in rows}
    for length in (5, 15, 30, 45):
        by = {row["method"]: row for row in rows if row["frames"] == length and row["kind"] == "mean of kinds"}
        assert by[f"{name}, best of 8 by truth"]["l2p"] <= by[f"{name}, one draw"]["l2p"]
        assert by[f"{name}, one draw"]["spread_cm"] > 0
        assert by[f"{name}, calm, raw"]["apart_cm"] > 0


@pytest.mark.slow
def test_what_is_told_in_the_middle_is_met_by_all(folder, capsys):
    network, card = tiny_stitcher.network(config=LONG), replace(tiny_stitcher.card(LONG), data={"held_out": HELD_OUT})
    checkpoints.save(network.state_dict(), card, folder / "told.safetensors")
    stitcher = str(folder / "told.safetensors")
    rows = measure(folder, capsys, "--partial-keys", "--raw", "--stitcher", stitcher)
    told = ["nothing", "both hands", "a foot", "the hips", "hands overhead"]
    names = (str(folder / "ours.safetensors"), f"{stitcher}, calm")
    assert [(row["told"], row["by"]) for row in rows] == [(what, name) for what in told for name in names]
    for row in rows:
        assert row["windows"] == 2
        assert row["missed_cm"] < 0.1
        assert ("ade_cm" in row) == (row["told"] != "hands overhead")  # which mocap did not do
    by = {(row["told"], row["by"]): row for row in rows}
    for what in told[1:]:
        assert by[what, names[1]]["step_cm"] != by["nothing", names[1]]["step_cm"]


@pytest.mark.slow
def test_with_a_density_there_are_its_rollouts_and_the_best_draw_by_its_energy(folder, capsys):
    names = []
    for number in range(2):
        network = tiny_stitcher.network(config=LONG, seed=number)
        card = replace(tiny_stitcher.card(LONG), data={"held_out": HELD_OUT})
        checkpoints.save(network.state_dict(), card, folder / f"stitch-{number}.safetensors")
        names.append(str(folder / f"stitch-{number}.safetensors"))
    prior = save_tiny_prior(folder / "prior.safetensors", held_out=HELD_OUT)
    words = ("--count", "1", "--past", "1", "--raw", "--stitcher", ",".join(names), "--prior", prior)
    rows = measure(folder, capsys, *words)
    methods = {row["method"] for row in rows}
    assert {"rollouts", *(f"{name}, best of 8 by {which}" for name in names for which in ("truth", "energy"))} < methods
    by = {row["method"]: row for row in rows if row["frames"] == 15 and row["kind"] == "mean of kinds"}
    for name in names:
        nearest, likeliest = (by[f"{name}, best of 8 by {which}"]["l2p"] for which in ("truth", "energy"))
        assert nearest <= likeliest


@pytest.mark.parametrize(
    ("option", "save"), [("--stitcher", tiny_stitcher.save_tiny_stitcher), ("--prior", save_tiny_prior)]
)
def test_models_that_saw_the_clips_are_refused(folder, capsys, option, save):
    save(folder / "seen.safetensors")
    words = ["--data", folder / "data", "--inbetweener", folder / "ours.safetensors"]
    assert run("bench", "transitions", *words, option, folder / "seen.safetensors") == 2
    assert "was trained on bandai/a_walk_0.bvh" in capsys.readouterr().err


@pytest.mark.slow
def test_errors_over_the_frames_are_drawn(folder, tmp_path, capsys):
    network, card = tiny_stitcher.network(config=LONG), replace(tiny_stitcher.card(LONG), data={"held_out": HELD_OUT})
    checkpoints.save(network.state_dict(), card, folder / "curve.safetensors")
    names = [str(folder / f"{each}.safetensors") for each in ("ours", "curve")]
    rows = measure(folder, capsys, "--past", "1", "--stitcher", names[1], "--over-time", tmp_path / "errors.png")
    assert [(row["by"], row["frame"]) for row in rows] == [(name, frame) for name in names for frame in range(1, 31)]
    one, several = rows[:30], rows[30:]
    assert all(row["nearest_cm"] == row["farthest_cm"] > 0 for row in one)
    assert all(row["nearest_cm"] < row["error_cm"] < row["farthest_cm"] for row in several)
    assert several[0]["error_cm"] < several[15]["error_cm"] > several[29]["error_cm"]  # both ends are known
    assert (tmp_path / "errors.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--partial-keys", "--auto"], "leave --prior and --auto out"),
        (["--over-time", "a.png", "--prior", "general"], "leave --prior and --auto out"),
        (["--partial-keys", "--over-time", "a.png"], "choose one"),
        (["--over-time", "a.bvh"], "draws a .png"),
    ],
)
def test_options_that_exclude_each_other_are_refused(folder, capsys, words, said):
    asked = ["--data", folder / "data", "--inbetweener", folder / "ours.safetensors", *words]
    assert run("bench", "transitions", *asked) == 2
    assert said in capsys.readouterr().err


def test_clips_that_are_no_longer_there_are_said(folder, tmp_path, capsys):
    (tmp_path / "empty").mkdir()
    words = ["--data", tmp_path / "empty", "--inbetweener", folder / "ours.safetensors"]
    assert run("bench", "transitions", *words) == 2
    assert "does not hold the clips kept from training" in capsys.readouterr().err
