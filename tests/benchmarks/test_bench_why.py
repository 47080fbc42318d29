"""`mapctl bench why`: generated clips of each variant, what gives them away, and what is refused."""

import json
from dataclasses import replace

import pytest
from helpers import run, tiny_density, walk
from tiny_prior import save_tiny_prior

from controllers.benchmarks.generation import list_variants, why
from mapctl.errors import RequestError
from mapctl.metrics.realism import ClassifierSettings, RealismSettings
from mapctl.metrics.realism.evidence.kinds import GAITS
from priors import checkpoints

QUICK = RealismSettings(classifier=ClassifierSettings(folds=2, width=8, batch=32, learning_rate=3e-3))
SETTINGS = why.WhyBenchmarkSettings(count=8, seconds=2.0, steps=(2, 40), realism=QUICK)


@pytest.fixture(scope="module")
def mocap():
    return [walk(62, cadence=0.8 + 0.05 * k, seed=k) for k in range(8)]


@pytest.fixture
def prior(tmp_path):
    """A prior with clips that it was not trained on."""
    path = save_tiny_prior(tmp_path / "tiny.safetensors")
    tensors, card = checkpoints.load(path)
    names = [f"{k}.bvh" for k in range(8)]
    checkpoints.save(tensors, replace(card, data=card.data | {"held_out": {"test": names}}), path)
    for name in names:
        walk(40).save(tmp_path / name)
    return path


def test_each_variant_is_compared_at_each_number_of_steps(mocap):
    variants = list_variants(tiny_density(), None, {}, {})[:1]
    parts = why.benchmark_why(variants, mocap, SETTINGS)
    assert [(row["variant"], row["steps"]) for row in parts["accuracy"]] == [("density", 2), ("density", 40)]
    strict = parts["accuracy"][1]
    assert strict["told_apart"] > 0.9  # a density that has learnt nothing
    assert strict["low"] <= strict["told_apart"] <= strict["high"]
    rows = [row for row in parts["gaits"] if row["steps"] == 40]
    assert {row["gait"] for row in rows} <= set(GAITS)
    assert sum(row["mocap_windows"] for row in rows) == 8 * 4
    assert strict["above_floor"]
    named = [row for name in why.SHARES for row in parts[name]]
    assert named
    assert {row["steps"] for row in named} == {40}
    assert all(row["low"] > 0 for row in named)
    assert len(parts["cells"]) <= 16


def run_bench(prior, *more):
    return ["bench", "why", "--prior", prior, "--data", prior.parent, *more]


def test_variants_and_sizes_are_chosen(prior, capsys, monkeypatch):
    def measure(variants, mocap, settings):
        about = {"clips": len(mocap), "count": settings.count, "seconds": settings.seconds, "steps": settings.steps}
        return {"accuracy": [{"variant": each.name, **about} for each in variants], "gaits": []}

    monkeypatch.setattr("mapctl.commands.bench.generation.why.benchmark_why", measure)
    sizes = ["--count", 9, "--seconds", 3, "--steps", "5,6", "--json"]
    assert run(*run_bench(prior, *sizes)) == 0
    told = json.loads(capsys.readouterr().out)
    about = {"part": "accuracy", "clips": 8, "count": 9, "seconds": 3.0, "steps": [5, 6]}
    assert told["bench"] == "why"
    assert told["rows"] == [{"variant": name, **about} for name in ("density", "density, footing")]
    assert run(*run_bench(prior, *sizes, "--variants", "density")) == 0
    assert [row["variant"] for row in json.loads(capsys.readouterr().out)["rows"]] == ["density"]


@pytest.mark.parametrize(
    ("more", "said"),
    [
        (["--steps", "many"], "--steps are whole numbers with commas between, got 'many'"),
        (["--steps", "0"], "steps of at least 1"),
        (["--seconds", "0"], "a length above 0 s"),
        (["--count", "3"], "at least 8 clips, got 3"),
        (["--variants", "poem"], "no variant is called 'poem'; there are density; density, footing"),
        (["--variants", "("], "--variants is no regular expression"),
    ],
    ids=str,
)
def test_what_cannot_be_is_refused(prior, fails, more, said):
    assert said in fails(*run_bench(prior, *more))


def test_settings_that_cannot_be_are_refused():
    with pytest.raises(RequestError, match="at least 4 clips, got 3"):
        replace(SETTINGS, count=3)
