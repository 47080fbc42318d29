"""`mapctl make`: scripts of what data lack, checks against mocap's ranges, a list, and cards that say what was made."""

import csv
import math
from itertools import pairwise

import pytest
import torch
from helpers import generator, random_motion, run, walk, write_corpus
from tiny_prior import save_tiny_prior

import mapctl
import priors
from mapctl.commands.make import run as make_run
from mapctl.commands.make.scripts import draw_script
from mapctl.commands.train.whole_set.plan import make_jobs
from mapctl.errors import FileFormatError
from mapctl.metrics.mocap_bounds import CHECKED, find_bounds, list_faults, measure_checked
from mapctl.protocols import DataLimits
from mapctl.skeleton import CANONICAL
from priors.training.bundled.models import list_models
from priors.training.mocap.made import find_made

pytestmark = pytest.mark.usefixtures("small_judgements")
LIMITS = DataLimits(slowest=0.5, fastest=2.0, turn_rate=1.5)
LOOSE = dict.fromkeys(CHECKED, 1e9)


@pytest.fixture
def prior(tmp_path):
    return save_tiny_prior(tmp_path / "prior.safetensors")


def make(tmp_path, prior, *words):
    data = tmp_path / "mocap"
    if not data.exists():
        write_corpus(data, 2)
    words = ("--reference", data, "--prior", prior, "--seconds", 3, "--count", 2, *words)
    return run("make", "-o", tmp_path / "set" / "made", *words)


def table(tmp_path):
    with (tmp_path / "set" / "made" / "made.csv").open() as file:
        return list(csv.DictReader(file))


@pytest.mark.parametrize("seed", range(30))
def test_scripts_stand_first_and_stay_within_what_the_prior_knows(seed):
    track, words = draw_script(LIMITS, 12.0, generator(seed))
    kinds = [word.split()[0] for word in words.split(", ")]
    assert kinds[0] == "stand"
    assert len(kinds) == len(track.times) >= 3
    assert track.times[-1] < 12
    for (before, after), kind in zip(pairwise(track.commands), kinds[1:], strict=True):
        assert after.speed <= LIMITS.max_steering_speed
        assert (after.speed == 0) == (kind in ("stop", "spin"))
        assert (after.turning is not None) == (kind == "spin")
        if kind == "veer":
            assert after.speed == before.speed > 0
            assert 0.5 < abs(after.heading - before.heading) < 2.2
        if kind in ("go", "leave"):
            assert before.speed == 0 < after.speed
            assert (abs(after.heading - before.heading) > 0.5) == (kind == "leave") or before.turning is not None
        if kind == "spin":
            assert before.speed == 0
            assert math.radians(59) < abs(after.turning or 0.0) < math.radians(121)
    assert all(before != after for before, after in pairwise(kinds))


def test_scripts_have_what_data_lack_and_the_seed_draws_them():
    drawn = [draw_script(LIMITS, 12.0, generator(seed))[1] for seed in range(30)]
    assert drawn == [draw_script(LIMITS, 12.0, generator(seed))[1] for seed in range(30)]
    assert len(set(drawn)) == 30
    assert {word.split()[0] for script in drawn for word in script.split(", ")} == {
        "stand",
        "go",
        "leave",
        "spin",
        "pace",
        "stop",
        "veer",
    }


def test_bounds_are_what_nearly_all_of_mocap_stays_under():
    walks = [walk(60, seed=seed) for seed in range(4)]
    bounds = find_bounds([*walks, walk(20)])
    rows = [measure_checked(motion) for motion in walks]
    for name in CHECKED:
        assert sorted(row[name] for row in rows)[-2] <= bounds[name] <= max(row[name] for row in rows)
    assert list_faults(rows[0], {name: bound * 1.01 for name, bound in bounds.items()}) == []
    wild = measure_checked(random_motion(CANONICAL, 60))
    assert {fault.split()[0] for fault in list_faults(wild, bounds)} >= set(CHECKED[2:5])
    assert find_bounds([walk(20)]) == {}


def test_one_frame_that_jumps_is_a_fault():
    bounds = find_bounds([walk(90, seed=seed) for seed in range(4)])
    jumping = walk(90)
    jumping.local_quat_xyzw[45, CANONICAL.index("leftUpperArm")] = torch.tensor([1.0, 0, 0, 0]).double()
    found = [fault.split()[0] for fault in list_faults(measure_checked(jumping), bounds)]
    assert "largest_step_cm" in found
    assert "largest_acceleration_m_s2" in found


def test_what_cannot_be_measured_is_a_fault():
    assert list_faults({"contact_speed_cm_s": math.nan}, {"contact_speed_cm_s": 5.0}) == [
        "contact_speed_cm_s nan, allowed are 5"
    ]


@pytest.mark.slow
def test_what_fails_is_listed_and_not_kept(tmp_path, prior, capsys):
    assert make(tmp_path, prior) == 0
    told, rows = capsys.readouterr().out, table(tmp_path)
    assert [row["kept"] for row in rows] == ["no", "no"]
    assert all("longest_slide_s" in row["why not"] for row in rows)  # it glides
    assert "kept 0 of 2 clips" in told
    assert not list((tmp_path / "set" / "made").glob("*.bvh"))


@pytest.mark.slow
def test_what_passes_is_kept_and_trained_on_by_name(tmp_path, prior, monkeypatch, capsys):
    monkeypatch.setattr(make_run, "find_bounds", lambda reference: LOOSE | {"jitter_m_s3": math.inf})
    assert make(tmp_path, prior, "--seed", 5, "--quiet") == 0
    rows = table(tmp_path)
    assert [row["kept"] for row in rows] == ["yes", "yes"]
    assert [row["seed"] for row in rows] == ["5", "6"]
    assert {row["licence"] for row in rows} == {"none, it is made up"}
    assert rows[0]["script"].startswith("stand, ")
    clips = [mapctl.load(tmp_path / "set" / "made" / row["file"]) for row in rows]
    assert [(clip.num_frames, clip.fps) for clip in clips] == [(90, 30), (90, 30)]
    assert not torch.equal(clips[0].root_position, clips[1].root_position)

    write_corpus(tmp_path / "set" / "mocap", 2)
    words = ("--width", 8, "--components", 2, "--window", 20, "--steps", 1, "--batch", 3, "--device", "cpu")
    capsys.readouterr()
    assert run("train", "lstm-gmm", "--data", tmp_path / "set", "-o", tmp_path / "run", *words) == 0
    said = "made/made.csv: 2 of 4 clips, by prior.safetensors (none, it is made up)"
    assert f"made, not captured: {said}" in capsys.readouterr().out
    assert priors.load(str(tmp_path / "run")).card.data["made"] == [said]


@pytest.mark.slow
def test_made_clips_of_another_folder_are_trained_on_beside_the_data(tmp_path, capsys):
    data, made = tmp_path / "data", tmp_path / "elsewhere"
    write_corpus(data, 6)
    write_corpus(made, 3)
    first, second, _ = sorted(file.name for file in made.glob("*.bvh"))
    table = "".join(f"{name},yes,free,CC0,1,,\n" for name in (first, second))
    (made / "made.csv").write_text("file,kept,model,licence,seed,script,why not\n" + table)
    words = ("--width", 8, "--components", 2, "--window", 20, "--steps", 1, "--batch", 3, "--device", "cpu", "--quiet")

    def train(name, *more):
        return run("train", "lstm-gmm", "--data", data, "-o", tmp_path / name, *words, *more)

    assert train("alone") == train("beside", "--made", made) == 0
    alone, beside = (priors.load(str(tmp_path / name)).card for name in ("alone", "beside"))
    assert beside.data["held_out"] == alone.data["held_out"]
    assert beside.data["trained_on"]["clips"] == alone.data["trained_on"]["clips"] + 2
    assert beside.data["made"] == ["made.csv: 2 of 3 clips, by free (CC0)"]
    assert "--made MADE" in beside.training["command"]
    assert "--made" not in alone.training["command"]
    (made / "made.csv").unlink()
    capsys.readouterr()
    assert train("none", "--made", made) == 2
    assert f"{made} holds no clips that mapctl make has listed as made" in capsys.readouterr().err
    assert train("nowhere", "--made", tmp_path / "nowhere") == 2
    assert "nowhere" in capsys.readouterr().err


def write_list(folder, licence, *names):
    folder.mkdir(parents=True)
    for name in names:
        (folder / name).write_text("")
    rows = "".join(f"{name},yes,locomotion,{licence},1,,\n" for name in names)
    (folder / "made.csv").write_text("file,kept,model,licence,seed,script,why not\n" + rows)
    return folder


def test_a_set_is_trained_on_made_clips_where_densities_know_walks(tmp_path, capsys):
    made = write_list(tmp_path / "made", "CC BY-NC 4.0", "a.bvh")
    assert run("train", "all", "--commands", "--made", made) == 0
    commands = dict(line.split(": ", 1) for line in capsys.readouterr().out.splitlines())
    assert {name for name, command in commands.items() if "--made MADE" in command} == {"locomotion", "locomotion-live"}
    (job, *_) = make_jobs(list_models(with_made=True), tmp_path, tmp_path / "set", 1.0, made=made)
    assert job.words[job.words.index("--made") + 1] == str(made)


def test_a_free_set_sees_no_clips_of_a_model_that_is_not_free(tmp_path, capsys):
    write_corpus(tmp_path / "mocap", 2)
    words = ("train", "all", "--data", tmp_path / "mocap", "-o", tmp_path / "set", "--weights", "free", "--made")
    assert run(*words, write_list(tmp_path / "theirs", "CC BY-NC 4.0", "a.bvh")) == 2
    assert "is under 'CC BY-NC 4.0'; weights that learn from it cannot be 'free for any use'" in capsys.readouterr().err
    assert run(*words, tmp_path / "mocap") == 2
    assert "holds no clips that mapctl make has listed" in capsys.readouterr().err
    assert not (tmp_path / "set").exists()


def test_a_list_that_is_none_is_named(tmp_path):
    (tmp_path / "made.csv").write_text("file,kept\n")
    with pytest.raises(FileFormatError, match=r"made\.csv, line 1: is no list of made clips"):
        find_made(tmp_path, ["walk.bvh"])
    (tmp_path / "made.csv").write_text("file,kept,model,licence,seed,script,why not\na.bvh,yes,free\n")
    with pytest.raises(FileFormatError, match="line 2: has 3 columns"):
        find_made(tmp_path, ["a.bvh"])


def test_clips_of_the_list_that_are_not_there_do_not_count(tmp_path):
    (tmp_path / "made.csv").write_text(
        "file,kept,model,licence,seed,script,why not\na.bvh,yes,free,CC0,1,,\nb.bvh,no,free,CC0,2,,\n"
    )
    found = find_made(tmp_path, ["a.bvh", "c.bvh"])
    assert found.told == ("made.csv: 1 of 2 clips, by free (CC0)",)
    assert found.clips == {"a.bvh"}


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("--count", 0), "the count must be 1 to 10000, got 0"),
        (("--seconds", 1), "a clip lasts 3 s or more, got 1"),
        (("--seed", -1), "the seed must be"),
        (("--prior", "nobody"), "nobody"),
        (("--reference", "nowhere"), "nowhere is not a folder of BVH files"),
        (("--match", "nothing"), "matches 'nothing'"),
    ],
)
def test_what_makes_no_sense_is_refused_and_nothing_written(tmp_path, prior, capsys, words, said):
    assert make(tmp_path, prior, *words) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert said in line
    assert not (tmp_path / "set" / "made").exists()


def test_a_folder_of_made_clips_is_not_written_into(tmp_path, prior, capsys):
    (tmp_path / "set" / "made").mkdir(parents=True)
    (tmp_path / "set" / "made" / "made.csv").write_text("mine")
    assert make(tmp_path, prior) == 2
    assert "holds made clips already" in capsys.readouterr().err
    assert (tmp_path / "set" / "made" / "made.csv").read_text() == "mine"
