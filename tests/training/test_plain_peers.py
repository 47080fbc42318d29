"""`mapctl train KIND --plain`: the plainest network of a kind, on the same data, for the same commands."""

import json
import math
from dataclasses import replace

import pytest
import tiny_denoiser
import torch
from helpers import corpus, generator, run, walk
from tiny_prior import save_walking_density

import priors
from mapctl import cli
from mapctl.commands.train.options import TrainOptions
from mapctl.errors import RequestError
from mapctl.recording import Capture
from mapctl.skeleton import CANONICAL
from priors.denoiser import network as denoisers
from priors.denoiser.network import ConvDenoiser, DenoiserConfig, DenoiserNetwork
from priors.lstm_gmm.network import LstmGmmConfig
from priors.refiner.network import RefinerConfig
from priors.training.augmentation.corruption import CorruptionSettings
from priors.training.quality.refiner import RefinerEvaluator, compute_realism_gap
from priors.training.recipes import denoiser as denoiser_recipe
from priors.training.recipes import lstm_gmm as density_recipe
from priors.training.recipes.denoiser import DenoiserRecipe, DenoiserSettings, DenoiserTrainer, compute_squared_losses
from priors.training.recipes.density.settings import TrainingSettings
from priors.training.recipes.density.trainer import DensityTrainer
from priors.training.recipes.lstm_gmm import DensityRecipe
from priors.training.recipes.refiner import RefinerRecipe
from priors.training.recipes.refining.plain import PlainRefinerRecipe, PlainRefinerSettings, PlainRefinerTrainer
from priors.training.recipes.refining.samples import compute_root_error
from priors.training.run import train

PLAIN = DenoiserConfig(width=8, plain=True)
QUIET = CorruptionSettings(clean=1.0, markers=0.0, spikes=0.0, dropout=0.0, limb=0.0, gap=0.0)


def plain_network(*, drawn=0.0):
    with torch.random.fork_rng():
        torch.manual_seed(0)
        network = DenoiserNetwork(PLAIN)
        if drawn:
            torch.nn.init.normal_(network.last.weight, std=drawn)
    return network.eval().requires_grad_(False)


def make_capture(frames=60, *, sigma=0.05):
    seen = torch.ones(frames, CANONICAL.num_joints, dtype=torch.bool)
    sigmas = torch.full((CANONICAL.num_joints,), sigma)
    return Capture.of_motion(walk(frames), seen=seen, seen_root=seen[:, 0], sigma=sigmas, sigma_root=sigma)


def request(kind, *words):
    place = [] if "--data" in words else ["--data", "data", "-o", "run"]
    given = cli.parse(["train", kind, *place, *words])
    assert isinstance(given, TrainOptions)
    return given.recipe()


def test_an_untrained_plain_denoiser_returns_what_it_was_given():
    given = make_capture()
    cleaned = plain_network()(given)
    angles = torch.cat([given.tilt, given.joints.flatten(2)], dim=-1)
    assert torch.allclose(cleaned.pose.angles, angles, atol=1e-5)
    assert torch.allclose(cleaned.pose.root_position, given.root, atol=1e-5)
    assert not torch.allclose(tiny_denoiser.network()(given).pose.angles, angles, atol=1e-3)  # ours smooths


def test_its_changes_do_not_fade_where_there_is_no_noise():
    still = make_capture(sigma=0.0)
    for network, fades in ((plain_network(drawn=0.3), False), (tiny_denoiser.network(drawn=0.3), True)):
        changed = (network(still).pose.root_position - still.root).abs().max()
        assert (changed < 1e-4) == fades


def test_it_sees_all_frames_of_a_piece_and_their_order():
    network, given = plain_network(drawn=0.3), make_capture()
    moved = given.joints.clone()
    moved[:, 50] += 0.5
    before, after = network(given), network(replace(given, joints=moved))
    assert (before.pose.angles - after.pose.angles)[:, 0].abs().max() > 1e-5
    still = torch.zeros(1, 5, denoisers._OBSERVED_CHANNELS)
    assert torch.diff(network.plain(still), dim=1).abs().amax(dim=-1).min() > 1e-2


def test_a_long_capture_is_cleaned_in_pieces_of_which_each_is_as_long_as_a_window():
    network, given, shown = plain_network(drawn=0.1), make_capture(150), []
    forward = network.forward
    network.forward = lambda capture: shown.append(capture.frames) or forward(capture)
    cleaned = ConvDenoiser("plain", network, tiny_denoiser.card()).clean(given)
    assert cleaned.contact_logits.shape == (1, 150, 2)
    assert max(shown) == DenoiserSettings().window
    middle = forward(given.slice(48, 112))
    assert torch.allclose(cleaned.contact_logits[:, 64:96], middle.contact_logits[:, 16:48], atol=1e-5)


def test_what_is_wrong_costs_its_square_in_the_networks_own_units():
    settings, windows = replace(denoiser_recipe.PLAIN[1], corruption=QUIET, spread=0.0), corpus(1, 30).features[None]
    network = plain_network()
    right = compute_squared_losses(network, windows, settings, generator())
    assert right["squares"] < 1e-6
    assert right["loss"] == pytest.approx(settings.contacts * math.log(2), rel=1e-3)
    turn, off = 62, 63  # after the angles: the heading, then the place
    network.last.bias[turn] = 2.0
    wrong = compute_squared_losses(network, windows, settings, generator())["squares"]
    network.last.bias[turn] = 0.0
    network.last.bias[off + 1] = 3.0
    other = compute_squared_losses(network, windows, settings, generator())["squares"]
    assert float(wrong) == pytest.approx(4 / 66, rel=1e-3)
    assert float(other) == pytest.approx(9 / 66, rel=1e-3)


@pytest.mark.slow
def test_a_plain_denoiser_learns_by_squares_and_is_judged_as_ours():
    settings = replace(denoiser_recipe.PLAIN[1], steps=60, batch=6, window=24, learning_rate=3e-3)
    trainer, rows = DenoiserTrainer(replace(PLAIN, width=16), settings, corpus(1, 30)), []
    for _ in range(40):
        trainer.generator.manual_seed(1)
        rows.append(trainer.train_step())
    assert set(rows[0]) == {"loss", "squares", "contacts_nats"}
    assert rows[-1]["squares"] < 0.8 * rows[0]["squares"]
    ours = DenoiserTrainer(tiny_denoiser.CONFIG, DenoiserSettings(batch=2, window=24), corpus(1, 30))
    assert set(trainer.validate(corpus(2, 30))) == set(ours.validate(corpus(2, 30)))


@pytest.mark.parametrize("width", ["6", "9"])
def test_a_width_that_heads_cannot_share_is_refused(width):
    with pytest.raises(RequestError, match="multiple of 4"):
        request("denoiser", "--plain", "--width", width)


def test_a_plain_density_has_one_gaussian_of_independent_values_and_likelihood_alone():
    given = request("lstm-gmm", "--plain", "--width", "8")
    assert given.config == LstmGmmConfig(width=8, components=1, correlated=False, knows_noise=False)
    assert given.settings == density_recipe.PLAIN[1]
    settings = replace(given.settings, steps=40, batch=4, window=20, learning_rate=5e-3)
    trainer = DensityTrainer(given.config, settings, corpus())
    trainer._add_moment_gradient = lambda windows: pytest.fail("free runs are held to the data")
    losses = [trainer.train_step()["loss"] for _ in range(40)]
    assert sum(losses[-5:]) < sum(losses[:5]) - 10
    assert trainer.network.whitening is None


class _SampledRefiner(PlainRefinerTrainer):
    """Of the walks and of walks that tremble."""

    def __init__(self, settings):
        config, walks = RefinerConfig(width=8, memory=8, lookahead=1, joints=("hips", "rightToes")), corpus()
        noisy = walks.features + 0.02 * torch.randn(walks.features.shape, generator=generator())
        super().__init__(config, settings, walks, replace(walks, features=noisy))


@pytest.mark.slow
def test_a_plain_refiner_comes_nearer_to_moments_at_one_rate_and_has_no_critic():
    settings = PlainRefinerSettings(rounds=60, window=20, batch=8, learning_rate=1e-2)
    trainer, rows = _SampledRefiner(settings), []
    assert list(trainer.networks()) == ["network"]
    for _ in range(60):
        trainer.generator.manual_seed(1)  # the same windows each time
        rows.append(trainer.train_step())
    assert rows[-1]["moments"] < 0.8 * rows[0]["moments"]
    assert trainer.compute_learning_rate() == settings.learning_rate


def test_the_hips_way_is_held_with_its_weight():
    """What is added to the steps of the hips costs as much as it moves them."""
    trainers = [_SampledRefiner(PlainRefinerSettings(window=20, batch=4, root=root)) for root in (0.0, 20.0)]
    for trainer in trainers:
        torch.nn.init.normal_(trainer.network.last.bias, std=0.2, generator=generator())
    with torch.no_grad():
        free, held = (trainer.losses() for trainer in trainers)
        trainer = trainers[0]
        trainer.generator.manual_seed(PlainRefinerSettings().seed)
        raw = trainer.raw.draw(4, trainer.generator).features
        metres = compute_root_error(raw[:, trainer.network.before :], trainer.network(raw)[0])
    assert float(held["loss"] - free["loss"]) == pytest.approx(20 * float(metres), rel=0.02)
    assert float(metres) > 1e-6
    assert float(free["loss"]) == pytest.approx(10 * float(free["moments"]), rel=1e-4)


@pytest.mark.parametrize(
    ("settings", "message"),
    [({"window": 7}, "window must be at least 8"), ({"rounds": 0}, "rounds must be at least 1")],
    ids=["window", "rounds"],
)
def test_settings_without_sense_are_refused(settings, message):
    with pytest.raises(RequestError, match=message):
        PlainRefinerSettings(**settings)


@pytest.mark.parametrize("kind", ["lstm-gmm", "refiner"])
def test_plain_and_paper_are_two_variants(kind):
    with pytest.raises(RequestError, match="--paper and --plain"):
        request(kind, "--plain", "--paper")


def test_a_prior_s_own_network_is_not_made_plain():
    with pytest.raises(RequestError, match="--plain do not apply"):
        request("lstm-gmm", "--plain", "--init", "locomotion")


@pytest.mark.parametrize(
    ("recipe", "kind", "words"),
    [
        (DenoiserRecipe, "denoiser", ["--width", "16", "--steps", "9"]),
        (DensityRecipe, "lstm-gmm", ["--width", "16", "--components", "2", "--steps", "20000"]),
        (PlainRefinerRecipe, "refiner", ["--steps", "9", "--seed", "4"]),
    ],
    ids=["denoiser", "lstm-gmm", "refiner"],
)
def test_the_command_of_a_card_asks_for_the_same_run(recipe, kind, words):
    """With --plain and without; the density also as the paper has it, where its steps are those that are usual else."""
    variants = [["--plain"], [], *([["--paper"]] if kind == "lstm-gmm" else [])]
    for variant in variants:
        wanted = request(kind, "--match", "walk", "--bfloat16", *words, *variant)
        assert isinstance(wanted, recipe if variant == ["--plain"] or kind != "refiner" else RefinerRecipe)
        typed = wanted.format_command().replace("'", "").replace("DATA", "data").replace("RUN", "run").split()
        assert ("--plain" in typed, "--paper" in typed) == ("--plain" in variant, "--paper" in variant)
        assert request(typed[2], *typed[3:]) == wanted


@pytest.mark.slow
def test_the_command_line_trains_a_plain_denoiser_that_denoise_begins_with(tmp_path, data, capsys):
    out = tmp_path / "run"
    words = ("--steps", 2, "--batch", 2, "--window", 32, "--width", 8, "--plain", "--quiet")
    assert run("train", "denoiser", "--data", data, "-o", out, *words) == 0
    card = priors.load_denoiser(str(out)).card
    assert (card.config, card.training["settings"]["squared"]) == (PLAIN.as_card(), True)
    assert card.training["command"].endswith("--plain --steps 2 --batch 2 --window 32")
    assert run("info", out) == 0
    assert "--plain" in capsys.readouterr().out
    clip = data / "walk-0.bvh"
    assert run("denoise", clip, "-o", tmp_path / "out.bvh", "--denoiser", out, "--report", tmp_path / "r.json") == 0
    assert json.loads((tmp_path / "r.json").read_text())


@pytest.mark.slow
def test_a_plain_refiner_is_trained_kept_at_its_best_and_loaded(tmp_path, data):
    path = save_walking_density(tmp_path / "walks.safetensors")
    config = RefinerConfig(width=6, memory=5, lookahead=1, joints=("hips", "rightToes"))
    settings = PlainRefinerSettings(rounds=4, window=10, batch=4)
    out, few = tmp_path / "run", {"samples": 6, "judged": 2, "seconds": 1.2, "validate_steps": 2}
    recipe = PlainRefinerRecipe(data, out, config=config, settings=settings, density=str(path), minutes=1.0, **few)
    train(recipe)
    refiner = priors.load_refiner(str(out))
    assert refiner.network.config == config
    assert refiner.card.training["command"].endswith("--batch 4 --window 10 --steps 4 --plain")
    curve = refiner.card.training["curve"]
    assert [row["round"] for row in curve] == [0, 2, 4]
    assert all(math.isfinite(row["training_loss"]) for row in curve[1:])
    assert refiner.card.quality["round"] == min(curve, key=compute_realism_gap)["round"]


def test_a_plain_refiner_is_measured_as_any_other(monkeypatch):
    trainer, shown = _SampledRefiner(PlainRefinerSettings(window=20, batch=4)), []
    monkeypatch.setattr(RefinerEvaluator, "__call__", lambda self, network: shown.append(network) or {"a_ratio": 1.0})
    trainer.evaluate = RefinerEvaluator.__new__(RefinerEvaluator)
    assert trainer.validate(corpus()) == {"a_ratio": 1.0}
    assert shown == [trainer.network]


def test_usual_settings_are_ours():
    assert request("denoiser").settings == DenoiserSettings()
    assert not request("denoiser").config.plain
    assert request("lstm-gmm").settings == TrainingSettings()
