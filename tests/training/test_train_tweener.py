"""What `mapctl train tweener` is made of; its runs are tested in test_runs."""

from dataclasses import replace

import pytest
import tiny_path
import tiny_tweener
import torch
from helpers import corpus, generator

from mapctl import kinematics, rotations
from mapctl.skeleton import CANONICAL
from priors.training.recipes.tweener import (
    KeySettings,
    LossWeights,
    TweenerSettings,
    TweenerTrainer,
    compute_tweener_losses,
    draw_splices,
    draw_style_poses,
    draw_windows,
    measure_gap,
)
from priors.training.windows import PoseWindows
from priors.tweener import ConstrainedPose, GeneratedPoses, GeneratorNetwork

SETTINGS = TweenerSettings(steps=30, batch=96, learning_rate=1e-2, layout=KeySettings(longest=60.0))
ERRORS = ("places_cm", "pace_cm", "feet_cm", "keys_cm", "turns")


@pytest.fixture(scope="module")
def windows():
    return PoseWindows(corpus(3, 140), kinds=(), evenness=1.0)


class Told(GeneratorNetwork):
    """Answers with the motion itself, turned about the vertical by some radians."""

    def __init__(self, motion, turned=0.0):
        super().__init__(tiny_tweener.CONFIG)
        self.motion, self.turned = motion, turned

    def forward(self, image, style):
        local = self.motion.local_matrices()
        own = rotations.to_matrix(rotations.about_y(self.turned - image.heading))
        local = torch.cat([(own @ local[..., 0, :, :])[..., None, :, :], local[..., 1:, :, :]], dim=-3)
        places = kinematics.positions_from_matrices(CANONICAL, local)
        return GeneratedPoses(ConstrainedPose(local, places), ())


def losses_of(sequences, windows, turned=0.0, foreign=0.0):
    poses = draw_style_poses(windows, sequences, foreign, generator())
    styled = torch.ones(len(poses), dtype=torch.bool)
    made = Told(sequences.motion, turned)
    return compute_tweener_losses(made, tiny_path.network(), sequences, poses, styled, LossWeights())


def one_window(windows, frames=100):
    return draw_windows(windows, 3, frames, SETTINGS.layout, progress=1.0, tempo=0.0, generator=generator())


def test_the_truth_costs_nothing_between_keys_of_one_clip(windows):
    found = losses_of(one_window(windows), windows)
    assert all(float(found[name]) < 0.02 for name in ERRORS)


def test_a_body_that_faces_elsewhere_costs_as_far_as_it_is_off(windows):
    sequences = one_window(windows)
    found = losses_of(sequences, windows, turned=0.1)
    places = kinematics.positions_from_matrices(CANONICAL, sequences.motion.local_matrices())
    radius = places[..., ::2].norm(dim=-1).mean()
    assert float(found["places_cm"]) == pytest.approx(100 * 2 * float(radius) * 0.05, rel=0.1)
    assert float(found["turns"]) > 0.005


def test_between_keys_of_different_clips_only_keys_and_style_count(windows):
    layout = KeySettings(longest=200.0)
    sequences = draw_splices(windows, 2, 600, layout, progress=1.0, generator=generator())
    hidden = ~sequences.truthful
    assert bool(hidden.any())
    quats = torch.where(hidden[..., None, None], sequences.motion.quats.roll(7, dims=1), sequences.motion.quats)
    root = torch.where(hidden[..., None], 3.0, sequences.motion.root_position)
    other = replace(sequences, motion=replace(sequences.motion, quats=quats, root_position=root))
    generous = LossWeights(style=0.0)
    made = Told(sequences.motion)
    poses = draw_style_poses(windows, sequences, 0.0, generator())
    styled = torch.zeros(2, dtype=torch.bool)
    one, two = (
        compute_tweener_losses(made, tiny_path.network(), each, poses, styled, generous) for each in (sequences, other)
    )
    assert float(one["loss"]) == pytest.approx(float(two["loss"]), rel=1e-4)


def test_keys_that_tell_less_ask_for_less(windows):
    sequences = one_window(windows)
    none = torch.zeros(21, 3, dtype=torch.bool)
    none[0, ::2] = True
    axes = sequences.told.axes & none
    placed = replace(sequences, told=replace(sequences.told, axes=axes))
    assert float(losses_of(sequences, windows, turned=0.3)["keys_cm"]) > 1
    assert float(losses_of(placed, windows, turned=0.3)["keys_cm"]) < 1e-3


@pytest.mark.slow
def test_training_brings_poses_nearer():
    made = corpus(4, 140)
    trainer = TweenerTrainer(tiny_tweener.CONFIG, SETTINGS, made, tiny_path.network())
    before = trainer.validate(made)
    for _ in range(SETTINGS.steps):
        trainer.train_step()
    after = trainer.validate(made)
    (name,) = [name for name in after if name.endswith("error_cm")]
    assert after[name] < 0.75 * before[name]


def test_slerp_between_two_poses_is_measured_beside_what_is_made(windows):
    motion = windows.at(torch.tensor([0]), torch.zeros(1, dtype=torch.long), 100, torch.ones(1))
    found = measure_gap(Told(motion), motion)
    assert found["made"].error < 1e-3 * found["made"].count
    assert found["made"].speed == pytest.approx(found["true"].speed, rel=1e-3)
    assert found["slerp"].error > 0.5 * found["slerp"].count
    assert found["slerp"].jerk < 0.2 * found["true"].jerk
