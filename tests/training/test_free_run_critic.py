"""A critic of the density's free runs: what it sees, what the density learns of it, and runs that resume to the bit."""

import pytest
import torch
from helpers import corpus, generator

from mapctl.features import LAYOUT
from mapctl.skeleton import CANONICAL
from mapctl.terms.trial import Trial
from priors.lstm_gmm.network import LstmGmmConfig
from priors.training.moment_matching import MatchingSettings
from priors.training.recipes import lstm_gmm as free_runs
from priors.training.recipes.lstm_gmm import CriticSettings, DensityTrainer, TrainingSettings

CRITIC = CriticSettings(frames=8, head_start=2, batch=4, history=8, every=1)
SETTINGS = TrainingSettings(
    steps=5, batch=4, window=20, critic_steps=3, critic=CRITIC, matching=MatchingSettings(wander=4, batch=4)
)


def make_trainer(settings: TrainingSettings = SETTINGS) -> DensityTrainer:
    return DensityTrainer(LstmGmmConfig(width=8, components=1), settings, corpus())


def windows(frames: int = 12) -> torch.Tensor:
    return torch.stack([clip[10 : 10 + frames] for clip in corpus().clips()])


def test_it_sees_joints_about_the_hips_their_velocities_and_the_hips_where_the_window_began():
    features = windows()
    rows, joints = free_runs.show(features), Trial.of_features(features).joints_world
    about, velocity, hips = rows.split([3 * CANONICAL.num_joints, 3 * CANONICAL.num_joints, 3], dim=-1)
    assert rows.shape[1] == features.shape[1] - 1
    reach = (joints - joints[:, :, :1] * torch.tensor([1.0, 0.0, 1.0]))[:, 1:].norm(dim=-1)
    torch.testing.assert_close(about.unflatten(-1, (-1, 3)).norm(dim=-1), reach)
    speed = 30 * torch.diff(joints, dim=1).norm(dim=-1)
    torch.testing.assert_close(velocity.unflatten(-1, (-1, 3)).norm(dim=-1), speed, atol=1e-4, rtol=1e-4)
    travelled = (joints[:, 1:, 0, ::2] - joints[:, :1, 0, ::2]).norm(dim=-1)
    torch.testing.assert_close(hips[..., ::2].norm(dim=-1), travelled)
    # Forwards is forwards, wherever the character faces.
    steps = LAYOUT.pick(features, "root_displacement_heading")  # each in the heading of the frame before it
    torch.testing.assert_close(hips[:, 0, ::2], steps[:, 1], atol=1e-6, rtol=1e-4)


def test_the_density_hears_it_in_the_last_steps_only(monkeypatch):
    trainer, heard = make_trainer(), []
    score = trainer.judge.score
    monkeypatch.setattr(trainer.judge, "score", lambda *run: (heard.append(trainer.step), score(*run))[1])
    rows = [trainer.train_step() for _ in range(5)]
    assert heard == [2, 3, 4]
    assert [row["critic"] for row in rows[:2]] == pytest.approx([1.386, 1.386], abs=1e-3)
    assert all(row["critic"] != rows[0]["critic"] for row in rows[2:])


def test_its_gradient_is_what_would_make_free_runs_pass():
    trainer = make_trainer()
    while trainer.step < 2:
        trainer.train_step()
    trainer._introduce(trainer.judge)
    state = trainer.generator.get_state()

    def run_again() -> torch.Tensor:
        trainer.generator.set_state(state)
        return trainer._run_free(windows(21), windows(21).new_zeros(len(windows(21)), 0))[0]

    def believe(made: torch.Tensor) -> float:
        """Mean logit that free runs are captured."""
        return float(trainer.judge.network(free_runs.show(made[:, -9:])).mean().detach())

    made = run_again()
    before = believe(made)
    trainer.network.zero_grad()
    trainer._add_gradient(trainer.judge.score(made, generator()))
    with torch.no_grad():
        for weight in trainer.network.parameters():
            if weight.grad is not None:
                weight -= 1e-4 * weight.grad
    assert believe(run_again()) > before
