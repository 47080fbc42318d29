"""The clearance term: toes that travel are off the ground, those that stand are let alone."""

import pytest
import torch
from helpers import walking_trial

from mapctl.skeleton import CANONICAL, TOES
from mapctl.terms import Clearance

FRAMES = 20
INDICES = CANONICAL.indices(TOES)


@pytest.fixture
def trial():
    return walking_trial(FRAMES)


def speeds(trial):
    return torch.stack([trial.step(toe)[..., ::2].norm(dim=-1) for toe in INDICES], dim=-1)[0] * trial.fps


def test_what_lacks_is_the_height_asked_of_that_speed_less_the_own(trial):
    term = Clearance(height=0.3, speed=0.8, sigma=0.05, rest_height=0.02)
    own = trial.joints_world[0, :, INDICES, 1] - 0.02
    lacking = (0.3 * (speeds(trial) / 0.8).clamp(max=1) - own).clamp_min(0)
    assert float((lacking > 0).double().mean()) > 0
    torch.testing.assert_close(term(trial)[0], 0.5 * (lacking / 0.05).square().sum(-1), atol=1e-4, rtol=1e-4)
    torch.testing.assert_close(term.residual(trial)[0], lacking.amax(-1), atol=1e-5, rtol=1e-5)
