"""Training that begins with a prior's weights, and training in bfloat16."""

from dataclasses import replace
from functools import partial

import pytest
import torch
from helpers import write_corpus

import priors
from priors.lstm_gmm.network import LstmGmmConfig
from priors.training import loop
from priors.training.recipes import lstm_gmm
from priors.training.recipes.lstm_gmm import DensityRecipe, TrainingSettings

TINY = LstmGmmConfig(width=8, components=2)
SETTINGS = TrainingSettings(steps=6, batch=4, window=20)


@pytest.mark.slow
def test_fine_tuning_begins_with_the_priors_weights_statistics_and_labels(tmp_path, monkeypatch):
    whole = lstm_gmm.measure_free_runs
    monkeypatch.setattr(lstm_gmm, "measure_free_runs", partial(whole, runs=2, frames=20))
    request = DensityRecipe(
        write_corpus(tmp_path / "data"),
        tmp_path / "first",
        config=TINY,
        settings=SETTINGS,
        device="cpu",
        starts=4,
        labels=r"-(?P<number>[0-4])",
    )
    first = loop.train(request)
    slow = replace(SETTINGS, steps=1, learning_rate=1e-6)
    tuned = replace(request, out=tmp_path / "second", init=str(first), match="walk-[0-2]", settings=slow, labels="")
    before, after = (priors.load(str(path)) for path in (first, loop.train(tuned)))
    assert after.reference.config == before.reference.config
    assert len(after.reference.config.labels) == 3  # of the clips trained on
    for name, value in before.reference.state_dict().items():
        torch.testing.assert_close(after.reference.state_dict()[name], value, atol=2e-3, rtol=1e-3)
    assert torch.equal(after.feature_std, before.feature_std)
    assert after.card.data["init"] == {"name": first.name, "licence": before.card.licence}
