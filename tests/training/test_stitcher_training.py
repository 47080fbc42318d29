"""What a stitcher is taught with: latents that come nearest, critics that join late, and processes that all learn."""

import math
from dataclasses import replace

import numpy as np
import pytest
import tiny_stitcher
import torch
from helpers import corpus, write_corpus

import priors
from mapctl import cli
from mapctl.errors import RequestError
from mapctl.rotations import rotate_ground
from priors.stitching.joining import join_sides
from priors.stitching.latents import DrawnLatents
from priors.stitching.network import POSE, Gaussian
from priors.stitching.sides import Ends, Sides, count_made, walk_sides
from priors.training.adversaries.sliding_windows import (
    LONG,
    SHORT,
    SlidingCritics,
    compute_critic_loss,
    compute_generator_loss,
    compute_slope,
)
from priors.training.augmentation.transition_windows import Known, Transition, TransitionWindows
from priors.training.parallel import fork_group
from priors.training.quality.stitcher import TEMPERATURES, calibrate_temperature, place
from priors.training.recipes import stitcher as recipe_module
from priors.training.recipes.stitcher import PAPER, StitcherRecipe, StitcherSettings, StitcherTrainer
from priors.training.recipes.stitcher_critics import CriticSettings, show_sides, show_truth
from priors.training.recipes.stitcher_latents import TRIES, PrintedLatents, sample_nearest
from priors.training.recipes.stitcher_losses import Shares, find_stitcher_losses, interpolate
from priors.training.run import train

SETTINGS = StitcherSettings(steps=10, batch=6, window=24, critics=CriticSettings(begin=0.3, head_start=2))


def seeded(seed=0):
    return torch.Generator().manual_seed(seed)


BARE = Known()


def transitions(count=6, frames=20, known=BARE) -> Transition:
    return TransitionWindows(corpus(2, 80), kinds=(), evenness=0.0).draw(count, frames, known, seeded())


def follow_truth(truth: Transition, made: int) -> Sides:
    """Both sides as they were captured."""
    features, (ground, heading) = truth.truth()[:, :, :made], truth.integrate()
    place = torch.stack([ground[:, :made], ground[:, :-1].flip(1)[:, :made]])
    facing = torch.stack([heading[:, :made], heading[:, :-1].flip(1)[:, :made]])
    nothing = torch.zeros(2, len(ground), made, 4)
    return Sides(truth.frames, features, features[..., -2:], place, facing, nothing, nothing, nothing[:, :, 0])


def make_trainer(without=(), **settings):
    config = replace(tiny_stitcher.CONFIG, without=without)
    return StitcherTrainer(config, replace(SETTINGS, **settings), corpus(2, 80))


@pytest.mark.parametrize("known", [BARE, Known(10, 3)])
def test_critics_see_of_captured_motion_what_they_see_of_sides_that_follow_it(known):
    truth = transitions(known=known)
    shown = show_sides(follow_truth(truth, 12), truth.ends())
    torch.testing.assert_close(shown.flatten(0, 1), show_truth(truth, 12), atol=1e-4, rtol=0)


def test_what_critics_see_depends_neither_on_place_nor_on_heading():
    truth = transitions()
    ends, sides = truth.ends(), follow_truth(truth, 12)
    there, turn = torch.tensor([3.0, -2.0]), torch.tensor(0.7)
    moved = replace(sides, place=rotate_ground(sides.place, turn) + there, heading=sides.heading + turn)
    at = Ends(ends.features, ends.present, rotate_ground(ends.place, turn) + there, ends.turn + turn)
    # The first end stands where the frame of reference begins: the side that starts from the second is compared.
    torch.testing.assert_close(show_sides(moved, at)[1], show_sides(sides, ends)[1], atol=1e-3, rtol=0)


def test_critics_score_every_window_and_motion_too_short_for_one_has_none_of_it():
    critics, rows = SlidingCritics(), show_truth(transitions(), 12)
    assert [scores.shape for scores in critics(rows)] == [(12, 13 - SHORT), (12, 13 - LONG)]
    assert [scores.shape for scores in critics(rows[:, : LONG - 1])] == [(12, LONG - SHORT)]


def test_losses_of_the_two_that_contend_are_least_squares():
    real, made = [torch.tensor([[1.0, 2.0]])], [torch.tensor([[0.0, 3.0]])]
    assert float(compute_critic_loss(real, made)) == pytest.approx(0.5 + 4.5)
    assert float(compute_generator_loss(made)) == pytest.approx((1 + 4) / 2)


@pytest.mark.slow
def test_the_slope_is_that_of_finite_differences():
    with torch.random.fork_rng():
        torch.manual_seed(0)
        critics = SlidingCritics().double()
    rows = show_truth(transitions(1), 12)[:1].double()

    def score(at):
        return sum(float(scores.detach().mean()) for scores in critics(at))

    slope, step = 0.0, 1e-4
    for column in range(rows.numel()):
        off = torch.zeros_like(rows).flatten().index_fill(0, torch.tensor([column]), step).view_as(rows)
        slope += ((score(rows + off) - score(rows - off)) / (2 * step)) ** 2
    assert float(compute_slope(critics, rows).detach()) == pytest.approx(slope, rel=1e-3)


@pytest.mark.slow
def test_critics_join_after_their_share_of_the_steps_and_are_heard_after_a_head_start():
    trainer = make_trainer()
    before = [weight.clone() for weight in trainer.critics.network.parameters()]
    rows = [trainer.train_step() for _ in range(3)]
    assert all(torch.equal(one, other) for one, other in zip(before, trainer.critics.network.parameters(), strict=True))
    assert {row["told"] for row in rows} == {0.5}
    rows = [trainer.train_step() for _ in range(4)]
    assert not all(
        torch.equal(one, other) for one, other in zip(before, trainer.critics.network.parameters(), strict=True)
    )
    assert [SETTINGS.critics.ramp(updates) for updates in (0, 2, 3, 4, 9)] == [0.0, 0.0, 0.5, 1.0, 1.0]


@pytest.mark.slow
def test_critics_learn_to_tell_what_trembles_from_what_was_captured():
    trainer, last = make_trainer(critics=CriticSettings(rate=1e-3)), 20
    truth = transitions(32)
    sides = follow_truth(truth, 12)
    noise = 0.05 * torch.randn(sides.features[..., POSE].shape, generator=seeded())
    trembling = sides.features.clone()
    trembling[..., POSE] += noise
    rows = []
    for _ in range(60):
        trainer.critics.hear(replace(sides, features=trembling), truth.ends(), torch.ones(32, dtype=torch.bool))
        rows.append(trainer.critics.learn(truth, trainer))
    # Single steps of a critic swing, on each kind of processor elsewhere.
    found = {name: sum(float(row[name]) for row in rows[-last:]) / last for name in rows[-1]}
    assert found["told"] > 0.9
    assert found["critic"] < 0.5


@pytest.mark.slow
def test_without_critics_there_are_none():
    trainer = make_trainer(without=("d",))
    rows = [trainer.train_step() for _ in range(5)]
    assert trainer.critics is None
    assert not any("critic" in name for row in rows for name in row)
    assert "critics" not in trainer.networks()


def test_motion_at_the_mean_is_not_judged():
    trainer, truth, asked = make_trainer(), transitions(10), []

    def judge(sides, ends, rows):
        asked.append(rows)
        return torch.zeros(())

    shares = Shares(informed=0.3, calm=0.4, nearest=0.2)
    parts, told = find_stitcher_losses(
        trainer.network, trainer.posterior, truth, shares, SETTINGS.weights.ease, seeded(), judge
    )
    assert asked[0].tolist() == [True] * 3 + [False] * 4 + [True] * 3
    assert "critics" in parts
    assert "critics" in told


@pytest.mark.slow
def test_the_nearest_of_several_draws_is_kept():
    network, truth, count = tiny_stitcher.network(drawn=1.0), transitions(8), 8
    nearest = sample_nearest(network, truth, seeded())
    made = nearest.slow.shape[2]
    tried = DrawnLatents.sample(network.config, TRIES * count, made, seeded())

    def measure(latents):
        away = walk_sides(network, truth.ends(), truth.frames, latents).place_joints() - truth.place_joints(made)
        return away.norm(dim=-1).mean(dim=(0, 2, 3))

    every = torch.stack([measure(tried.rows(torch.arange(count) + count * number)) for number in range(TRIES)])
    torch.testing.assert_close(measure(nearest), every.amin(dim=0))
    assert float((every.amax(dim=0) - every.amin(dim=0)).min()) > 1e-4


def test_of_no_transitions_none_is_kept():
    nothing = sample_nearest(tiny_stitcher.network(), transitions().rows(torch.arange(0)), seeded())
    assert nothing.shared.shape[0] == nothing.slow.shape[1] == 0


def gather_from_two(work):
    """What `work` finds in each of two processes, by row."""
    found = []

    def told(group):
        found.append(group.gather(work(group)[None]))

    with fork_group(2, told) as group:
        told(group)
    return found[0]


@pytest.mark.slow
def test_two_processes_have_the_mean_gradient_of_their_posteriors_too():
    def find_gradients(group):
        trainer = make_trainer()
        trainer.limit_gradients = lambda: None
        trainer.join(group)
        trainer.take_step()
        weights = trainer.posterior.parameters()
        return torch.cat([each.grad.flatten() for each in weights if each.grad is not None])

    one, other = gather_from_two(find_gradients)
    assert one.any()
    assert torch.equal(one, other)


@pytest.mark.slow
def test_critics_learn_alike_where_one_process_was_shown_nothing():
    def learn(group):
        trainer, truth = make_trainer(), transitions()
        trainer.join(group)
        before = torch.cat([each.detach().flatten() for each in trainer.critics.network.parameters()])
        if group.leads:
            trainer.critics.hear(follow_truth(truth, 12), truth.ends(), torch.ones(6, dtype=torch.bool))
        assert set(trainer.critics.learn(truth, trainer)) == {"critic", "told"}
        assert trainer.critics.learn(truth, trainer) == {}
        return torch.cat([each.detach().flatten() for each in trainer.critics.network.parameters()]) - before

    one, other = gather_from_two(learn)
    assert one.any()
    assert torch.equal(one, other)


def make_printed(**settings):
    config = replace(tiny_stitcher.CONFIG, shared=0, own=4, printed=True)
    return StitcherTrainer(config, replace(PAPER[1], steps=10, batch=6, window=24, **settings), corpus(2, 80))


@pytest.mark.slow
def test_as_printed_all_are_drawn_and_compared_and_the_encoder_is_held_to_a_standard_normal():
    trainer, truth = make_printed(), transitions()
    shares, settings = trainer.settings.shares, trainer.settings.weights
    parts, told = find_stitcher_losses(trainer.network, None, truth, shares, settings.ease, seeded())
    assert [name for name, value in told.items() if name[-3:] == "_cm" and not value.any()] == ["places_cm", "calm_cm"]
    assert "posterior" not in trainer.networks()
    with torch.no_grad():  # a prior that says standard normal costs nothing
        for heads in (trainer.network.now, trainer.network.arrived):
            for layer in heads.parameters():
                layer.zero_()
    still, _ = find_stitcher_losses(trainer.network, None, truth, shares, settings.ease, seeded())
    assert float(parts["own"].detach()) > 0 == float(still["own"].detach())


@pytest.mark.slow
def test_as_printed_losses_count_by_what_they_are_before_training():
    trainer = make_printed()
    assert set(trainer.untrained) == {"places", "state", "contacts", "stitching"}
    weights = trainer.settings.weights
    parts = {name: torch.tensor(value) for name, value in trainer.untrained.items()}
    loss = weights.weigh(parts, trainer.untrained)
    assert float(loss) == pytest.approx(weights.places + weights.state + weights.contacts + weights.stitching)
    assert make_trainer().untrained == {}


@pytest.mark.slow
def test_as_printed_critics_learn_from_the_first_update_on():
    trainer = make_printed()
    before = [weight.clone() for weight in trainer.critics.network.parameters()]
    for _ in range(3):  # the shortest transitions have no window to judge
        trainer.train_step()
    assert not all(map(torch.equal, before, trainer.critics.network.parameters()))
    assert trainer.settings.critics.ramp(0) == 1.0


@pytest.mark.slow
@pytest.mark.parametrize("without", [(), ("d",)])
def test_as_printed_every_part_can_be_left_out(without):
    config = replace(tiny_stitcher.CONFIG, shared=0, own=4, printed=True, without=without)
    settings = replace(PAPER[1], steps=4, batch=4, window=24)
    assert math.isfinite(StitcherTrainer(config, settings, corpus(1, 80)).train_step()["loss"])


def test_as_printed_the_divergence_counts_the_side_that_steps():
    latents = PrintedLatents(torch.zeros(3, 0), torch.zeros(2, 3, 4, 2))
    far = Gaussian(torch.tensor([2.0, 4.0])[:, None, None].expand(2, 3, 2), torch.zeros(2, 3, 2))
    for _ in range(2):
        latents.own(far, torch.zeros(2, 3, 1), 0)
    assert [float(each) for each in latents.nats] == [4.0, 16.0]  # half the square, of two numbers


def test_critics_say_nothing_of_a_batch_at_the_mean():
    trainer = make_trainer()
    truth = transitions()
    heard = trainer.critics.hear(follow_truth(truth, 12), truth.ends(), torch.zeros(6, dtype=torch.bool))
    assert float(heard) == 0.0
    assert trainer.critics.learn(truth, trainer) == {}


@pytest.mark.parametrize("words", [[], ["--paper"], ["--paper", "--steps", "12000"]])
def test_the_command_on_the_card_is_the_one_that_was_typed(words, tmp_path, monkeypatch):
    asked = []
    monkeypatch.setattr("priors.training.run.train", lambda recipe, *_, **__: asked.append(recipe) or tmp_path / "x")
    cli.main(["train", "stitcher", "--data", str(tmp_path), "-o", str(tmp_path / "run"), *words])
    assert asked[0].format_command().split()[7:] == words


@pytest.mark.slow
def test_the_temperature_is_the_largest_at_which_the_best_draw_is_as_near_as_any():
    """By numpy, of answers that are drawn and placed anew, in the one gap that these clips have room for."""
    network = tiny_stitcher.network(drawn=0.3)
    windows = TransitionWindows(corpus(2, 60), kinds=(), evenness=0.0)
    found = calibrate_temperature(network, windows)
    truth = windows.draw(96, 16, BARE, torch.Generator().manual_seed(15))
    places = interpolate(truth)[0].joints_world()[:, :-1].numpy()
    made, scores = count_made(network, 16), {}
    for temperature in TEMPERATURES:
        draws, generator = [], torch.Generator().manual_seed(0)
        for _ in range(8):
            noise = DrawnLatents.sample(network.config, 96, made, generator)
            scaled = DrawnLatents(temperature * noise.shared, temperature * noise.slow)
            draws.append(place(join_sides(walk_sides(network, truth.ends(), 16, scaled))).numpy())
        away = np.stack([np.linalg.norm(draw - places, axis=-1).mean(axis=(1, 2)) for draw in draws])
        scores[temperature] = away.min(axis=0).mean()
    assert found == max(each for each, score in scores.items() if score <= 1.01 * min(scores.values()))


@pytest.mark.slow
def test_a_run_writes_the_temperature_that_it_finds(tmp_path, monkeypatch):
    monkeypatch.setattr(recipe_module, "calibrate_temperature", lambda network, windows: 2.5)
    data = write_corpus(tmp_path / "data")
    settings = replace(SETTINGS, steps=2)
    train(StitcherRecipe(data, tmp_path / "run", config=tiny_stitcher.CONFIG, settings=settings))
    assert float(priors.load_stitcher(str(tmp_path / "run")).network.temperature) == 2.5


@pytest.mark.parametrize("shares", [Shares(-0.1, 0.5, 0.2), Shares(0.6, 0.4, 0.1), Shares(0.0, 0.0, 0.0)])
def test_shares_that_are_none_are_refused(shares):
    with pytest.raises(RequestError, match="shares of a batch"):
        StitcherSettings(shares=shares)
