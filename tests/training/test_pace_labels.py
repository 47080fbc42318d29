"""Paces as labels: told by how a window ends, kept by the prior, and read from what its card says of the clips."""

import numpy as np
import pytest
import torch
from helpers import generator, go_at, run, write_corpus
from trainable_models import small_settings

import priors
from priors.lstm_gmm.density import PACE_LABELS, Labels, read_pace_rates
from priors.lstm_gmm.network import LstmGmmConfig
from priors.training.data import Corpus, follow_paces, measure_pace_changes
from priors.training.recipes.lstm_gmm import DensityTrainer

pytestmark = pytest.mark.usefixtures("small_judgements")
WINDOW = 20


@pytest.fixture(scope="module")
def clips() -> Corpus:
    """Who stands, who sets off and stops again, and who runs after a walk."""
    parts = [go_at(0.0, seconds=4), go_at(0.0, 1.2, 0.0, seconds=3), go_at(1.2, 3.0, seconds=3)]
    return Corpus(("a", "b_walk", "c"), tuple(map(len, parts)), torch.cat(parts))


@pytest.fixture
def trainer(clips, tmp_path):
    names = ("gait=walk", *PACE_LABELS)
    known = Labels(("gait=walk",), torch.tensor([[0.0], [1.0], [0.0]])).renamed(names)
    settings = small_settings("lstm-gmm", tmp_path, tmp_path, batch=64, window=WINDOW)
    return DensityTrainer(settings, clips, LstmGmmConfig(width=4, labels=names), known, follow_paces(clips))


def test_a_window_is_labelled_by_how_it_ends(trainer, clips, monkeypatch):
    paces, seen = follow_paces(clips), set()
    drawn = trainer.windows.draw(64, generator(3))
    monkeypatch.setattr(trainer.windows, "draw", lambda *_, **__: drawn)
    _, shown = trainer.draw_windows()
    for row, first in zip(shown, drawn.first.tolist(), strict=True):
        ends = int(paces[first + WINDOW])
        assert row[1:].tolist() in (np.eye(3)[ends].tolist(), [0, 0, 0])  # some windows are shown no pace
        seen.add((int(paces[first]), ends))
    assert {(0, 0), (0, 1), (1, 0), (1, 2)} <= seen


def test_rates_are_those_of_the_clips(clips):
    holds = measure_pace_changes(clips)
    minutes = holds["minutes by pace"]
    assert sum(minutes.values()) == pytest.approx(len(clips.features) / 1800, abs=0.02)
    rates = read_pace_rates(holds)
    assert rates["stand", "walk"] == pytest.approx(1 / (60 * minutes["stand"]))
    assert rates["walk", "stand"] == pytest.approx(1 / (60 * minutes["walk"]))
    assert rates["walk", "run"] == pytest.approx(1 / (60 * minutes["walk"]))
    assert rates["run", "walk"] == 0.0
    nobody = holds | {"minutes by pace": {"stand": 1.0, "walk": 2.0, "run": 0.0}}
    assert set(read_pace_rates(nobody)) == {("stand", "walk"), ("walk", "stand")}


@pytest.mark.slow
def test_a_density_that_is_trained_so_knows_paces(tmp_path, capfd):
    data = write_corpus(tmp_path / "data")
    words = "--match", "", "--width", 8, "--steps", 2, "--batch", 4, "--window", 12
    assert run("train", "lstm-gmm", "--data", data, "-o", tmp_path / "run", *words, "--label-pace") == 0
    prior = priors.load(str(tmp_path / "run"))
    assert prior.labels == {"pace": ["stand", "walk", "run"]}
    assert prior.pace_rates == read_pace_rates(prior.card.data["holds"])
    starts = prior.conditioned_on(["walk"]).initial_states
    assert bool((starts.speed > 0.4).all())
    told = prior.conditioned_on(["pace=run"]).reference.fc1.bias
    assert not torch.equal(told, prior.reference.fc1.bias)
    # A run that goes on with it has its labels, and one that begins without them is refused.
    more = ("--data", data, "--match", "", "--steps", 1, "--batch", 4, "--window", 12)
    for out, words in (("on", ("--label-pace",)), ("unasked", ())):
        assert run("train", "lstm-gmm", "-o", tmp_path / out, *more, *words, "--init", tmp_path / "run") == 0
        assert priors.load(str(tmp_path / out)).labels == prior.labels
    assert run("train", "lstm-gmm", "-o", tmp_path / "plain", *more, "--width", 8) == 0
    assert priors.load(str(tmp_path / "plain")).pace_rates == {}
    capfd.readouterr()
    assert run("train", "lstm-gmm", "-o", tmp_path / "no", *more, "--label-pace", "--init", tmp_path / "plain") == 2
    assert "was not trained with labels of paces; leave --label-pace out" in capfd.readouterr().err
