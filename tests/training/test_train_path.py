"""What `mapctl train path` is made of; its runs are tested in test_runs."""

from dataclasses import replace

import pytest
import tiny_path
import torch
from helpers import corpus, generator

from mapctl.inbetweening.root_trajectory import LocalMotion, RootTrajectory
from priors.path import PathNetwork
from priors.training.data import Corpus
from priors.training.recipes.path import PathSettings, PathTrainer, compute_path_losses, measure_clip
from priors.training.windows import PoseWindows

SETTINGS = PathSettings(steps=30, batch=128, window=40, learning_rate=1e-2)


class Told(PathNetwork):
    """Answers with the motion's own steps, as they are or longer, and a height that is off."""

    def __init__(self, motion, stretch=1.0, higher=0.0):
        super().__init__(tiny_path.CONFIG)
        self.motion, self.stretch, self.higher = motion, stretch, higher

    def forward(self, motion: LocalMotion) -> RootTrajectory:
        root = self.motion.root_position
        steps = torch.diff(root[..., ::2], dim=1, prepend=root[:, :1, ::2])
        # Of motions that do not turn; their heading frame is any frame's.
        return RootTrajectory(self.stretch * steps, root[..., 1] + self.higher, 20 * (2 * self.motion.contacts - 1))


@pytest.fixture
def straight():
    """A window of clips that face along Z."""
    windows = PoseWindows(corpus(3, 100), kinds=(), evenness=1.0)
    motion = windows.draw(2, 80, generator())
    return replace(motion, heading=torch.zeros_like(motion.heading))


def test_the_truth_costs_next_to_nothing(straight):
    losses = compute_path_losses(Told(straight), straight, SETTINGS)
    assert float(losses["loss"]) < 0.02


def test_steps_that_are_too_long_cost_what_they_sum_up_to_over_every_span(straight):
    losses = compute_path_losses(Told(straight, stretch=1.1), straight, SETTINGS)
    ground = straight.root_position[..., ::2]
    wanted = [
        10 * float((ground[:, span:] - ground[:, :-span]).norm(dim=-1).mean()) for span in (1, 2, 4, 8, 16, 32, 64)
    ]
    assert float(losses["path_cm"]) == pytest.approx(sum(wanted) / 7, rel=0.01)
    assert float(losses["V1_cm"]) == pytest.approx(wanted[0], rel=0.05)


def test_heights_are_judged_in_centimetres(straight):
    losses = compute_path_losses(Told(straight, higher=-0.02), straight, replace(SETTINGS, height=3.0))
    assert float(losses["height_cm"]) == pytest.approx(2.0, abs=1e-3)
    assert float(losses["loss"]) == pytest.approx(6.0, abs=0.05)


@pytest.mark.slow
def test_training_brings_the_trajectory_nearer():
    trainer = PathTrainer(tiny_path.CONFIG, SETTINGS, corpus(4, 100))
    before = trainer.validate(corpus(2, 90))
    for _ in range(SETTINGS.steps):
        trainer.train_step()
    after = trainer.validate(corpus(2, 90))
    assert after["all_V32_cm"] < 0.6 * before["all_V32_cm"]


def test_clips_are_measured_by_kind_and_each_as_far_as_it_is_long():
    made = corpus(3, 90)
    clips = Corpus(("a/walk_1", "a/run_1", "cmu/b"), (60, 90, 120), made.features)
    row = PathTrainer(tiny_path.CONFIG, SETTINGS, made).validate(clips)
    assert {name.rsplit("_", 2)[0] for name in row} == {"all", "walk", "run|dash", "^cmu"}
    assert "walk_V32_cm" in row
    assert "walk_V64_cm" not in row
    assert row["all_V64_cm"] == pytest.approx((row["run|dash_V64_cm"] + row["^cmu_V64_cm"]) / 2)
    windows = PoseWindows(clips, kinds=(), evenness=1.0)
    assert "V64" in measure_clip(tiny_path.network(), windows, 1)
