"""What a corpus holds, said in its card: speeds, starts and stops, turns, contacts."""

import json

import pytest
import torch
from helpers import corpus, run, walk_through, write_corpus

import priors
from mapctl.features import encode
from priors.training.corpus import Corpus
from priors.training.mocap.holdings import measure_holdings

pytestmark = pytest.mark.usefixtures("small_judgements")


def made(*motions):
    clips = [encode(motion)[0].float() for motion in motions]
    return Corpus(tuple(map(str, range(len(clips)))), tuple(map(len, clips)), torch.cat(clips))


def going(speeds, headings: float | torch.Tensor = 0.0, *, aside=0.0):
    """Along +Z, or `aside` from it (radians), at these speeds, m/s, one a frame."""
    way = torch.as_tensor(speeds, dtype=torch.float64).cumsum(0) / 30
    angle = torch.tensor(aside, dtype=torch.float64)
    return walk_through(torch.stack([way * torch.sin(angle), way * torch.cos(angle)], dim=1), headings=headings)


def test_minutes_are_told_by_speed():
    held = measure_holdings(made(going([0.0] * 900), going([0.4] * 450), going([1.3] * 1800), going([3.0] * 300)))
    assert held["minutes"] == pytest.approx(3450 / 1800, abs=0.01)
    by_speed = {"under 0.15 m/s": 0.5, "to 0.6": 0.25, "to 1.1": 0, "to 1.6": 1.0, "to 2.2": 0, "over": 0.17}
    assert held["minutes by speed"] == pytest.approx(by_speed, abs=0.02)
    assert held["starts"] == held["stops"] == 0


def test_starts_and_stops_are_counted_and_hesitations_are_none():
    go, stand, slow = [1.2] * 60, [0.0] * 60, [0.4] * 60
    held = measure_holdings(made(going(stand + go + stand + go), going(go + slow + go), going(go + stand)))
    assert (held["starts"], held["stops"]) == (2, 2)


def test_turns_and_directions():
    spin = torch.linspace(0, 4.0, 90).double()
    held = measure_holdings(
        made(
            going([0.0] * 90, spin),
            going([1.0] * 90, spin[:90] / 4),
            going([1.0] * 90, 3.14),
            going([1.0] * 60, aside=1.6),
        )
    )
    assert held["seconds of turning on the spot"] == pytest.approx(3.0, abs=0.5)
    assert held["seconds of turning under way"] == 0
    assert held["seconds of going backwards"] == pytest.approx(3.0, abs=0.2)
    assert held["seconds of going sideways"] == pytest.approx(2.0, abs=0.2)


def test_contacts_and_clips_of_a_frame():
    whole = corpus(3)
    share = float(whole.features[:, -2:].mean())
    assert measure_holdings(whole)["share of frames with a foot planted, each"] == pytest.approx(share, abs=1e-3)
    one = Corpus(("a", "b"), (1, len(whole.features) - 1), whole.features)
    assert measure_holdings(one)["minutes"] == pytest.approx(len(whole.features) / 1800, abs=0.01)


@pytest.mark.slow
def test_the_card_of_a_density_says_it(tmp_path, capsys):
    data, out = write_corpus(tmp_path / "data"), tmp_path / "run"
    words = ("--width", 8, "--components", 2, "--window", 20, "--steps", 1, "--batch", 3, "--device", "cpu", "--quiet")
    assert run("train", "lstm-gmm", "--data", data, "-o", out, *words) == 0
    held = priors.load(str(out)).card.data["holds"]
    assert held["minutes"] == pytest.approx(400 / 1800, abs=0.01)
    assert held["minutes by speed"]["to 1.6"] > 0.1
    assert run("info", out) == 0
    assert json.loads(capsys.readouterr().out)["data"]["holds"] == held
