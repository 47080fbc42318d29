"""Free runs held to the data's moments: the penalty is zero for the data itself, and training lowers it."""

import numpy as np
import pytest
import torch
from helpers import corpus, finite_difference, generator, tiny_model

from mapctl.features import LAYOUT
from priors.lstm_gmm.density import PACE_LABELS, Labels
from priors.lstm_gmm.network import LstmGmmConfig
from priors.training.data import follow_paces
from priors.training.moment_matching import MatchingSettings, moment_loss, run_free
from priors.training.recipes.lstm_gmm import DensityTrainer, TrainingSettings

SETTINGS = MatchingSettings(batch=8, context=10, wander=0, frames=10)


def free_run_moment_loss(model, windows, settings, generator) -> torch.Tensor:
    return moment_loss(*run_free(model, windows, settings, generator), settings)


def windows(frames: int = 24) -> torch.Tensor:
    return torch.stack([clip[10 : 10 + frames] for clip in corpus().clips()])


def test_windows_compared_with_themselves_match():
    assert float(moment_loss(windows(), windows(), SETTINGS)) == 0


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
        (changed("root_height", lambda height: height - 0.05), "drift"),
    ],
)
def test_each_fault_costs_under_the_weight_that_is_meant_for_it(made, weight):
    off = {name: 0.0 for name in ("feet", "jerk", "pace", "spread", "drift") if name != weight}
    assert float(moment_loss(made, windows(), MatchingSettings(**off))) > 0.05


def test_its_gradient_is_that_of_the_run_with_the_draws_held():
    model = tiny_model(dtype=torch.float64).requires_grad_(True)
    at = model.out.bias.detach().clone()
    direction = torch.randn(at.shape, generator=generator(1), dtype=torch.float64)

    def value(bias: torch.Tensor) -> torch.Tensor:
        with torch.no_grad():
            model.out.bias.copy_(bias)
        return free_run_moment_loss(model, windows().double(), SETTINGS, generator())

    (gradient,) = torch.autograd.grad(value(at), model.out.bias)
    expected = finite_difference(lambda bias: value(bias).detach(), at, direction)
    assert float((gradient * direction).sum()) == pytest.approx(expected, rel=1e-4)


def labelled_trainer(**kwargs) -> DensityTrainer:
    """One that can be told a gait and a pace."""
    settings = TrainingSettings(steps=2, batch=4, window=12, untold=0.0, matching=MatchingSettings(wander=3, **kwargs))
    names = ("gait=walk", *PACE_LABELS)
    labels = Labels(names, torch.zeros(len(corpus().lengths), len(names)))
    config = LstmGmmConfig(width=8, components=1, labels=names)
    return DensityTrainer(config, settings, corpus(), labels=labels, paces=follow_paces(corpus()))


def test_a_run_is_that_of_the_network_which_was_told_the_pace_alone():
    trainer, seen = labelled_trainer(), windows(13)
    chosen = torch.arange(len(seen)) % 3
    told = torch.cat([seen.new_ones(len(seen), 1), seen.new_tensor(np.eye(3))[chosen]], -1)
    made, _ = trainer._run_free(seen, told)
    for number, pace in enumerate(PACE_LABELS):
        fresh = labelled_trainer()
        alone, _ = run_free(trainer.network.conditioned_on((pace,)), seen, trainer.settings.matching, fresh.generator)
        rows = chosen == number
        assert bool(rows.any())
        torch.testing.assert_close(made[rows].detach(), alone[rows].detach(), rtol=1e-4, atol=1e-5)
