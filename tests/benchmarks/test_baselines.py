"""Models that a table measures beside its own: the same rows, on clips that none of them has seen."""

import json
from dataclasses import replace

import pytest
import tiny_transformer
from helpers import run, tiny_density, walk
from tiny_prior import save_tiny_prior
from tiny_refiner import refiner_of

from controllers.benchmarks import generation
from controllers.benchmarks.shared.held_out import find_held_out
from mapctl import cli, retarget
from mapctl.commands import bench
from mapctl.commands.bench import baselines
from mapctl.errors import RequestError
from priors import checkpoints

HELD_OUT = {"validation": ["bandai/a_walk_0.bvh"], "test": ["bandai/a_walk_1.bvh"]}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Two clips, two in-betweeners that did not see them, and one that did."""
    path = tmp_path_factory.mktemp("baselines")
    for number in range(2):
        motion = walk(60, seed=number)
        clip = path / "data" / "bandai" / f"a_walk_{number}.bvh"
        clip.parent.mkdir(parents=True, exist_ok=True)
        retarget.from_canonical(motion, retarget.identify_rig(motion.skeleton)).save(clip)
    for name, drawn, held_out in (("ours", 0.0, HELD_OUT), ("plain", 0.3, HELD_OUT), ("seeing", 0.0, {})):
        card = replace(tiny_transformer.card(), data={"held_out": held_out})
        checkpoints.save(tiny_transformer.network(drawn=drawn).state_dict(), card, path / f"{name}.safetensors")
    return path


def test_rows_of_the_same_follow_each_other_and_name_their_model():
    rows = {"a": [{"what": 1}, {"what": 2}], "b": [{"what": 3}, {"what": 4}]}
    assert baselines.measure_each(["a", "b"], rows.__getitem__) == [
        {"model": "a", "what": 1},
        {"model": "b", "what": 3},
        {"model": "a", "what": 2},
        {"model": "b", "what": 4},
    ]
    assert baselines.measure_each(["b"], rows.__getitem__) == rows["b"]
    rows["b"].append({"what": 5})
    assert [row["what"] for row in baselines.measure_each(["a", "b"], rows.__getitem__)] == [1, 2, 3, 4, 5]


def test_models_are_named_once():
    assert baselines.list_models("ours", " a, b,") == ["ours", "a", "b"]
    assert baselines.list_models("ours", "") == ["ours"]
    for twice in ("ours", "a,b,a"):
        with pytest.raises(RequestError, match="each named once"):
            baselines.list_models("ours", twice)


_WITH_DATA = ("generation", "tween")


@pytest.mark.parametrize("table", ["free-run", "steer", "shots", *_WITH_DATA])
def test_tables_take_others_beside_their_own(table):
    words = ["--data", "mocap"] if table in _WITH_DATA else []
    given = cli.parse(["bench", table, *words, "--baselines", "one,two"])
    assert isinstance(given, bench.TABLES[table])
    assert vars(given)["baselines"] == "one,two"


def words_of(folder, table):
    return ["bench", table, "--data", folder / "data", "--inbetweener", folder / "ours.safetensors"]


@pytest.mark.parametrize("table", ["tween"])
def test_clips_that_another_model_has_seen_are_refused(folder, fails, table):
    seeing = folder / "seeing.safetensors"
    said = fails(*words_of(folder, table), "--baselines", seeing)
    assert f"{seeing} was trained on bandai/a_walk_0.bvh" in said


def test_inbetweeners_are_in_one_table(folder, capsys, monkeypatch):
    place = "mapctl.commands.bench.tween.benchmark_tweening"
    monkeypatch.setattr(place, lambda kinds, network, densities, progress: [{"what": network.name}])
    ours, plain = (str(folder / f"{name}.safetensors") for name in ("ours", "plain"))
    assert run(*words_of(folder, "tween"), "--baselines", plain, "--json") == 0
    rows = json.loads(capsys.readouterr().out)["rows"]
    assert [(row["model"], row["what"]) for row in rows] == [(ours, ours), (plain, plain)]


def test_densities_and_refiners_are_variants_by_their_names():
    prior, other = tiny_density(), tiny_density(seed=1)
    ours, theirs = refiner_of(), refiner_of()
    found = generation.list_variants(prior, ours, {"b": other}, {"c": theirs})
    planted = [each.name for each in found if each.sigma_planted is not None]
    assert planted == ["density, planted", "b, planted"]
    assert [
        (each.name, each.prior, each.refiner, each.foot_cleanup is not None)
        for each in found
        if each.sigma_planted is None
    ] == [
        ("density", prior, None, False),
        ("density, footing", prior, None, True),
        ("density, refiner", prior, ours, False),
        ("density, refiner, footing", prior, ours, True),
        ("density, c", prior, theirs, False),
        ("density, c, footing", prior, theirs, True),
        ("b", other, None, False),
        ("b, footing", other, None, True),
    ]


def test_free_runs_of_two_densities(tmp_path, capsys, monkeypatch):
    one, other = (save_tiny_prior(tmp_path / f"{name}.safetensors") for name in ("one", "other"))
    for path in (one, other):
        tensors, card = checkpoints.load(path)
        checkpoints.save(tensors, replace(card, quality=card.quality | {"data": {}}), path)
    monkeypatch.setattr("mapctl.commands.bench.free_run.benchmark_free_run", lambda prior, data: [{"run": prior.name}])
    assert run("bench", "free-run", "--prior", one, "--baselines", other, "--json") == 0
    rows = json.loads(capsys.readouterr().out)["rows"]
    assert rows == [{"model": str(path), "run": str(path)} for path in (one, other)]


def test_clips_are_those_whose_paths_hold_a_pattern(folder, fails):
    cards = {"ours": checkpoints.read_card(folder / "ours.json")}
    assert baselines.find_held_out(cards, "_1") == {"validation": [], "test": ["bandai/a_walk_1.bvh"]}
    assert baselines.find_held_out(cards) == HELD_OUT
    words = words_of(folder, "tween")
    assert "none of the clips that were kept for measuring has a path with 'cmu'" in fails(*words, "--clips", "cmu")
    assert "--clips is no regular expression" in fails(*words, "--clips", "(")


def test_a_model_has_not_seen_what_its_pattern_for_paths_leaves_out(folder):
    card = checkpoints.read_card(folder / "ours.json")
    other = replace(card, data={"match": "^cmu", "held_out": {}})
    assert baselines.find_held_out({"ours": card, "other": other}) == HELD_OUT
    seeing = replace(card, data={"match": "walk_0", "held_out": {}})
    with pytest.raises(RequestError, match="other was trained on bandai/a_walk_0"):
        baselines.find_held_out({"ours": card, "other": seeing})
    assert baselines.find_held_out({"ours": card, "other": seeing}, "walk_1")["test"] == ["bandai/a_walk_1.bvh"]


def test_clips_that_nothing_was_chosen_by_come_first(tmp_path):
    names = {"validation": ["a_walk_1.bvh"], "test": ["b_walk_2.bvh"]}
    for each in ("a_walk_1.bvh", "b_walk_2.bvh"):
        (tmp_path / each).touch()
    assert [path.name for path in find_held_out(tmp_path, names)] == ["b_walk_2.bvh", "a_walk_1.bvh"]
