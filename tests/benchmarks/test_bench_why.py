"""`mapctl bench why`: generated clips of each variant, what gives them away, and what is refused."""

import json
from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch
from helpers import run, tiny_density, walk
from tiny_prior import save_tiny_prior

from controllers.benchmarks import generation
from controllers.benchmarks.generation import continuations, list_variants, why
from controllers.benchmarks.shared.bones import put_on_generated_bones
from controllers.benchmarks.shared.held_out import NamedClip
from controllers.benchmarks.shots import fulfilment
from mapctl.errors import RequestError
from mapctl.metrics.realism import REGIONS, ClassifierSettings, RealismSettings, train_judges
from mapctl.metrics.realism.evidence.kinds import GAITS
from priors import checkpoints

QUICK = RealismSettings(classifier=ClassifierSettings(folds=2, width=8, batch=32, learning_rate=3e-3))
SETTINGS = why.WhyBenchmarkSettings(continued=False, count=8, seconds=2.0, steps=(2, 40), realism=QUICK)


@pytest.fixture(scope="module")
def mocap():
    return [NamedClip(f"{k}.bvh", walk(62, cadence=0.8 + 0.05 * k, seed=k)) for k in range(8)]


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


@pytest.mark.slow
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
    assert [row["region"] for row in parts["regions"]] == [*REGIONS]
    assert all(row["told_apart"] > 0.7 for row in parts["regions"])
    named = [row for name in why.SHARES for row in parts[name]]
    assert named
    assert {row["steps"] for row in named} == {40}
    assert all(row["low"] > 0 for row in named)
    assert len(parts["cells"]) <= 16


@pytest.mark.parametrize(("grown", "shared"), [(3e-4, True), (0.01, False)])
def test_rounded_bones_are_no_cause_and_another_body_stays_itself(mocap, grown, shared):
    clip = mocap[0].motion
    other = replace(clip, skeleton=replace(clip.skeleton, offsets=clip.skeleton.offsets * (1 + grown)))
    put = put_on_generated_bones(other)
    assert put.joint_positions().equal((clip if shared else other).joint_positions())


@pytest.mark.parametrize("compare", ["generation", "shots"])
def test_motion_is_compared_with_mocap_on_the_same_bones(mocap, monkeypatch, compare):
    clips = [each.motion for each in mocap[:2]]
    rounded = [replace(one, skeleton=replace(one.skeleton, offsets=one.skeleton.offsets * 1.0003)) for one in clips]
    shown, found = [], SimpleNamespace(accuracy=0.5, floor_accuracy=0.5, frechet=0.0, floor_frechet=0.0)
    module = generation if compare == "generation" else fulfilment
    monkeypatch.setattr(module, "measure_realism", lambda made, real, **how: shown.extend(real) or found)
    if compare == "generation":
        generation._measure_realism(clips, rounded, generation.GenerationBenchmarkSettings())
    else:
        fulfilment._tell_apart(clips, rounded, 0)
    assert [one.skeleton for one in shown] == [one.skeleton for one in clips]


def run_bench(prior, *more):
    return ["bench", "why", "--prior", prior, "--data", prior.parent, *more]


@pytest.mark.slow
def test_variants_and_sizes_are_chosen(prior, capsys, monkeypatch):
    def measure(variants, mocap, settings):
        about = {"clips": len(mocap), "count": settings.count, "seconds": settings.seconds, "steps": settings.steps}
        about |= {"continued": settings.continued}
        return {"accuracy": [{"variant": each.name, **about} for each in variants], "gaits": []}

    monkeypatch.setattr("mapctl.commands.bench.generation.why.benchmark_why", measure)
    sizes = ["--starts", "own", "--count", 9, "--seconds", 3, "--steps", "5,6", "--json"]
    assert run(*run_bench(prior, *sizes)) == 0
    told = json.loads(capsys.readouterr().out)
    about = {"part": "accuracy", "clips": 8, "count": 9, "seconds": 3.0, "steps": [5, 6], "continued": False}
    assert told["bench"] == "why"
    assert told["rows"] == [{"variant": name, **about} for name in ("density", "density, planted", "density, footing")]
    assert run(*run_bench(prior, *sizes, "--variants", "density")) == 0
    assert [row["variant"] for row in json.loads(capsys.readouterr().out)["rows"]] == ["density"]


@pytest.mark.parametrize(
    ("more", "said"),
    [
        (["--steps", "many"], "--steps are whole numbers with commas between, got 'many'"),
        (["--steps", "0"], "steps of at least 1"),
        (["--seconds", "0"], "a length above 0 s"),
        (["--starts", "own", "--count", "3"], "at least 8 clips, got 3"),
        ([], "no unseen clip is as long as 2.5 s"),
        (["--variants", "poem"], "no variant is called 'poem'; there are density; density, planted; density, footing"),
        (["--variants", "("], "--variants is no regular expression"),
    ],
    ids=str,
)
def test_what_cannot_be_is_refused(prior, fails, more, said):
    assert said in fails(*run_bench(prior, *more))


def test_settings_that_cannot_be_are_refused():
    with pytest.raises(RequestError, match="at least 4 clips, got 3"):
        replace(SETTINGS, count=3)


def test_clips_gone_on_with_are_as_long_as_what_they_are_compared_with_and_are_told_their_labels():
    told = []

    class Telling(type(tiny_density())):
        def conditioned_like_clip(self, name):
            told.append(name)
            return self

    density = tiny_density()
    variant = replace(list_variants(density, None, {}, {})[0], prior=Telling(**vars(density)))
    clips = [NamedClip(f"{k}.bvh", walk(frames, seed=k)) for k, frames in enumerate((76, 90, 75))]
    long = continuations.select_long_clips(clips)
    assert [clip.name for clip in long] == ["0.bvh", "1.bvh"]
    made = continuations.continue_clips(variant, long, 0)
    assert [each.num_frames for each in made] == [36, 50]
    assert [continuations.cut_continuation(clip).num_frames for clip in long] == [36, 50]
    assert told == ["0.bvh", "1.bvh"]
    first = made[0].root_position[0] - long[0].motion.root_position[40]
    assert float(first.norm()) < 0.1  # where the clip was
    other = continuations.continue_clips(variant, long, 1)
    assert not other[0].root_position.equal(made[0].root_position)


@pytest.mark.slow
def test_pairs_are_judged_by_networks_that_saw_neither():
    windows = [torch.randn(3, 30, 12, generator=torch.Generator().manual_seed(k)) for k in range(8)]
    judges = train_judges(windows, windows[::-1], generator=torch.Generator(), settings=replace(QUICK), paired=True)
    assert all(ours == theirs for ours, theirs in (fold.clips for fold in judges.folds))
    assert any(ours != theirs for ours, theirs in (fold.clips for fold in judges.floor_folds))
    with pytest.raises(RequestError, match="pairs need as many clips in each set, got 8 and 9"):
        train_judges(windows, [*windows, windows[0]], generator=torch.Generator(), settings=QUICK, paired=True)
