"""`mapctl train all --data-share` and `--by-motion`: sets of parts of the clips, and what more motion has brought."""

import math

import pytest
import torch
from helpers import run

from mapctl import cli
from priors import checkpoints
from priors.checkpoints import Card
from priors.training.bundled.models import list_models
from scenes.plots.scaling import Scaling, plot_scaling


def save(out, name, kind, minutes, quality, held_out=("a", "b")):
    """A finished model of a set."""
    data = {"held_out": {"test": list(held_out)}}
    data |= {"trained_on": {"clips": 3, "minutes": minutes}} if minutes else {}
    training = {"settings": {"steps": 50}, "ended": {"minutes": 2.0}, "curve": [], "command": "mapctl train"}
    card = Card(kind, {}, licence="none", data=data, training=training, quality=quality, **Card.layout_fields())
    folder = out / "weights"
    folder.mkdir(parents=True, exist_ok=True)
    checkpoints.save({"weights": torch.zeros(2)}, card, folder / f"{name}.safetensors")


@pytest.fixture
def sets(tmp_path):
    """The path's error falls by a tenth with each doubling, the density's by a nat of its 66 numbers."""
    for k, minutes in enumerate((10.0, 20.0, 40.0)):
        save(tmp_path / str(k), "path", "path", minutes, {"test": {"all_V1_cm": 0.9**k}})
        save(tmp_path / str(k), "locomotion", "lstm-gmm", minutes / 2, {"test_nats_per_frame": -100.0 - k})
    return [tmp_path / "1", tmp_path / "0", tmp_path / "2"]


def test_what_twice_the_motion_brings_is_the_slope_over_all_sets(sets, tmp_path, capsys):
    picture = tmp_path / "scaling.png"
    assert run("train", "all", "--by-motion", *sets, "-o", picture) == 0
    told = capsys.readouterr().out
    rows = [line.split() for line in told.splitlines() if line.split()[:1] in (["path"], ["locomotion"])]
    paths = [row for row in rows if row[0] == "path"]
    assert [row[1] for row in paths[:3]] == ["10", "20", "40"]
    assert [float(row[-1]) for row in paths[:3]] == pytest.approx([100 / 0.81 - 100, 100 / 0.9 - 100, 0], abs=0.01)
    assert [float(word) for word in paths[3][1:]] == pytest.approx([-10, -10], abs=0.01)
    density = [row for row in rows if row[0] == "locomotion"]
    assert float(density[3][-1]) == pytest.approx(100 * math.expm1(-1 / 66), abs=0.05)
    assert picture.read_bytes()[:4] == b"\x89PNG"


def test_a_curve_that_flattens_promises_no_more_than_its_end(tmp_path, capsys):
    for minutes, error in ((10.0, 1.0), (20.0, 0.5), (40.0, 0.45)):
        save(tmp_path / f"{minutes:g}", "path", "path", minutes, {"test": {"all_V1_cm": error}})
    assert run("train", "all", "--by-motion", *(tmp_path / name for name in ("10", "20", "40"))) == 0
    last = [line.split() for line in capsys.readouterr().out.splitlines() if line.split()[:1] == ["path"]][-1]
    assert [float(word) for word in last[1:]] == pytest.approx([100 * (math.sqrt(0.45) - 1), -10], abs=0.01)


def test_only_sets_that_can_be_compared_are(sets, tmp_path, fails, capsys):
    assert "by other amounts of motion" in fails("train", "all", "--by-motion", sets[0], sets[0])
    save(tmp_path / "old", "path", "path", None, {"test": {"all_V1_cm": 1.0}})  # a card that does not tell
    assert "by other amounts of motion" in fails("train", "all", "--by-motion", sets[0], tmp_path / "old")
    save(tmp_path / "foreign", "path", "path", 80.0, {"test": {"all_V1_cm": 1.0}}, held_out=("c",))
    assert "by other amounts of motion" in fails("train", "all", "--by-motion", sets[0], tmp_path / "foreign")
    for few in ([], [sets[0]]):
        assert "compares two sets at least" in fails("train", "all", "--by-motion", *few, "-o", tmp_path / "one.png")
    assert "asked for one at a time" in fails("train", "all", "--by-motion", sets[0], sets[1], "--commands")
    assert "writes .png" in fails("train", "all", "--by-motion", *sets, "-o", tmp_path / "scaling.pdf")
    assert "--data-share must be above 0" in fails("train", "all", "--commands", "--data-share", "1.5")


def test_each_model_is_trained_on_the_share(capsys):
    assert run("train", "all", "--commands", "--data-share", "0.25") == 0
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == len(list_models())
    for line in lines:
        words = line.partition(": ")[2]
        assert "--data-share 0.25" in words


def test_the_line_to_go_on_with_keeps_the_share():
    assert cli.parse(["train", "all", "--data-share", "0.5"]).format_command() == [
        *("mapctl", "train", "all"),
        *("--data-share", "0.5"),
    ]


def test_a_plot_for_each_model(tmp_path):
    one = Scaling("denoiser", "error", (50.0, 100.0, 200.0), (2.0, 1.8, 1.7), -8.0)
    plot_scaling([one], tmp_path / "one.png")
    plot_scaling([one, one], tmp_path / "two.png")
    assert (tmp_path / "two.png").stat().st_size > (tmp_path / "one.png").stat().st_size


@pytest.mark.parametrize("words", [("--check", "empty"), ("--compare", "empty", "empty")])
def test_a_folder_without_a_set_is_refused_in_one_line(fails, tmp_path, words):
    (tmp_path / "empty").mkdir()
    assert "empty holds no set of models" in fails("train", "all", *words)
