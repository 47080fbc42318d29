"""Free runs held to the data's moments: the penalty is zero for the data itself, and training lowers it."""

import pytest
import torch
from helpers import corpus, generator

from mapctl.errors import RequestError
from mapctl.features import LAYOUT
from priors.lstm_gmm import LstmGmmConfig
from priors.training.lstm_gmm import Trainer, TrainingSettings
from priors.training.matching import MatchingSettings, compare, mismatch

SETTINGS = MatchingSettings(batch=8, context=10, frames=10)


def windows(frames: int = 24) -> torch.Tensor:
    return torch.stack([clip[10 : 10 + frames] for clip in corpus().clips()])


def test_windows_compared_with_themselves_match():
    assert float(compare(windows(), windows(), SETTINGS)) == 0


def changed(block: str, change) -> torch.Tensor:
    made = windows()
    made[..., LAYOUT.slices[block]] = change(made[..., LAYOUT.slices[block]])
    return made


def shaken(values: torch.Tensor) -> torch.Tensor:
    return values + 0.05 * torch.randn(values.shape, generator=generator())


@pytest.mark.parametrize(
    ("made", "weight"),
    [
        (changed("root_displacement_heading", lambda step: 1.5 * step), "pace"),
        (changed("root_displacement_heading", lambda step: 1.5 * step), "feet"),
        (changed("root_height", lambda height: height + 0.05), "feet"),
        (changed("joint_rotations", shaken), "jerk"),
        (changed("joint_rotations", lambda vectors: 0.5 * vectors), "spread"),
    ],
)
def test_each_fault_costs_under_the_weight_that_is_meant_for_it(made, weight):
    off = {name: 0.0 for name in ("feet", "jerk", "pace", "spread") if name != weight}
    assert float(compare(made, windows(), MatchingSettings(**off))) > 0.05


def test_stiller_feet_than_mocaps_cost_nothing():
    only_feet = MatchingSettings(jerk=0, pace=0, spread=0)
    sliding = changed("root_displacement_heading", lambda step: 1.5 * step)
    assert float(compare(windows(), sliding, only_feet)) == 0
    assert float(compare(sliding, windows(), only_feet)) > 0


def test_training_lowers_the_mismatch_of_free_runs():
    settings = TrainingSettings(steps=150, batch=8, window=24, learning_rate=1e-2,
                                matching=MatchingSettings(begin=0.0, batch=8, context=10, frames=10))  # fmt: skip
    trainer = Trainer(LstmGmmConfig(width=16, components=2), settings, corpus())

    def mean_mismatch() -> float:
        with torch.no_grad():
            return sum(float(mismatch(trainer.model, windows(), SETTINGS, generator(k))) for k in range(3)) / 3

    before = mean_mismatch()
    for _ in range(settings.steps):
        trainer.train_step()
    assert mean_mismatch() < 0.7 * before


def test_windows_too_short_for_a_run_are_refused():
    trainer = Trainer(LstmGmmConfig(width=8, components=1), TrainingSettings(steps=1, batch=2, window=4), corpus())
    with pytest.raises(RequestError, match="at least 6 frames, got 5"):
        mismatch(trainer.model, windows(5), SETTINGS, generator())
