"""Parts of recipes, against independent formulas: losses of a true answer, masks, and critics."""

import math
from dataclasses import replace
from itertools import pairwise

import pytest
import tiny_denoiser
import tiny_infiller
import tiny_path
import tiny_transformer
import tiny_tweener
import torch
from helpers import corpus, generator
from trainable_models import small_settings

from mapctl import kinematics, rotations
from mapctl.features import LAYOUT, GroundPose, mirror_features
from mapctl.inbetweening import Proposal
from mapctl.inbetweening.partial_motion import KnownParts
from mapctl.inbetweening.pose_pairs import PosePairs
from mapctl.inbetweening.root_trajectory import LocalMotion, RootTrajectory
from mapctl.pose import decode
from mapctl.protocols import Inbetweener
from mapctl.skeleton import CANONICAL
from mapctl.terms.trial import Trial
from priors.path import PathNetwork
from priors.training import gaps
from priors.training.critics import FREE_RUN_MOMENTS, HistoryBuffer, MomentWeights, moment_loss, show
from priors.training.data import Corpus, compute_feature_statistics, find_window_starts
from priors.training.recipes import pose_transformer, tweener
from priors.training.recipes.denoiser import compute_denoiser_losses, draw_performers
from priors.training.recipes.infiller import compute_infiller_losses
from priors.training.recipes.keyframe_timing import solve_weights
from priors.training.recipes.path import compute_path_losses
from priors.training.recipes.pose_transformer import compute_losses, hide, sample_known_parts
from priors.training.recipes.refiner import compute_realism_gap, compute_root_error
from priors.training.recipes.tweener import (
    compute_tweener_losses,
    draw_splices,
    draw_style_poses,
    draw_windows,
    group_clips,
)
from priors.training.windows import FeatureWindows, PoseWindows
from priors.tweener import LABELS, ConstrainedPose, GeneratedPoses, GeneratorNetwork

pytestmark = pytest.mark.usefixtures("small_judgements")


def windows_of_clips(frames=24):
    return torch.stack([clip[10 : 10 + frames] for clip in corpus().clips()])


def with_gap(truth, start, stop):
    known = torch.ones(truth.heading.shape, dtype=torch.bool)
    known[:, start:stop] = False
    return replace(truth, known=KnownParts.whole(known))


@pytest.mark.slow
@pytest.mark.parametrize("name", ["lstm-gmm", "denoiser", "infiller", "pose-transformer", "path", "tweener"])
def test_the_loss_falls_on_a_batch_that_is_seen_again_and_again(name, data, tmp_path):
    settings = small_settings(name, data, tmp_path, steps=400, learning_rate=5e-3)
    trainer, rows = settings.make_trainer(settings.gather()), []
    for _ in range(40):
        trainer.generator.manual_seed(1)
        rows.append(trainer.train_step()["loss"])
    assert sum(rows[-5:]) < sum(rows[:5])


def test_statistics_are_symmetric_and_floored():
    mean, std = compute_feature_statistics(corpus().features)
    torch.testing.assert_close(mirror_features(mean[None])[0], mean, atol=1e-5, rtol=0)
    assert float(std.min()) >= 0.001
    assert bool((std[LAYOUT.continuous :] == 0.5).all())


def test_windows_compared_with_themselves_match_in_every_moment():
    assert float(moment_loss(windows_of_clips(), windows_of_clips(), FREE_RUN_MOMENTS)) == 0


@pytest.mark.parametrize(
    ("block", "change", "weight"),
    [
        ("root_displacement_heading", lambda step: 1.5 * step, "pace"),
        ("root_height", lambda height: height + 0.05, "feet"),
        ("joint_rotations", lambda vectors: vectors + 0.05 * torch.randn(vectors.shape, generator=generator()), "jerk"),
        ("joint_rotations", lambda vectors: 0.5 * vectors, "spread"),
        ("root_height", lambda height: height - 0.05, "drift"),
    ],
)
def test_each_fault_costs_under_the_weight_that_is_meant_for_it(block, change, weight):
    off = {name: 0.0 for name in ("feet", "jerk", "pace", "spread", "drift") if name != weight}
    changed = windows_of_clips()
    changed[..., LAYOUT.slices[block]] = change(changed[..., LAYOUT.slices[block]])
    assert float(moment_loss(changed, windows_of_clips(), MomentWeights(**off))) > 0.05


def test_the_critic_of_free_runs_sees_joints_velocities_and_the_hips_where_the_window_began():
    features = windows_of_clips(12)
    rows, joints = show(features), Trial.of_features(features).joints_world
    about, velocity, hips = rows.split([3 * CANONICAL.num_joints, 3 * CANONICAL.num_joints, 3], dim=-1)
    reach = (joints - joints[:, :, :1] * torch.tensor([1.0, 0.0, 1.0]))[:, 1:].norm(dim=-1)
    torch.testing.assert_close(about.unflatten(-1, (-1, 3)).norm(dim=-1), reach)
    speed = 30 * torch.diff(joints, dim=1).norm(dim=-1)
    torch.testing.assert_close(velocity.unflatten(-1, (-1, 3)).norm(dim=-1), speed, atol=1e-4, rtol=1e-4)
    steps = LAYOUT.pick(features, "root_displacement_heading")  # forwards, wherever the character faces
    torch.testing.assert_close(hips[:, 0, ::2], steps[:, 1], atol=1e-6, rtol=1e-4)


@pytest.mark.slow
def test_a_critic_of_free_runs_joins_the_last_steps_and_a_run_goes_on_from_among_them(data, tmp_path):
    settings = small_settings("lstm-gmm", data, tmp_path, batch=8, window=30, critic_steps=3)
    parts = settings.gather()
    whole, first, second = (settings.make_trainer(parts) for _ in range(3))
    rows = [whole.train_step() for _ in range(6)]
    assert [("critic" in row) for row in rows] == [False] * 3 + [True] * 3
    for _ in range(4):
        first.train_step()
    second.load_state(first.state(), 4)
    for _ in range(2):
        second.train_step()
    weights = [trainer.exported.state_dict() for trainer in (whole, second)]
    assert all(torch.equal(weights[0][name], weights[1][name]) for name in weights[0])


def test_a_history_puts_fresh_windows_in_place_of_kept_ones():
    history = HistoryBuffer(torch.zeros(10, 2, 3))
    history.keep(torch.ones(4, 2, 3), generator())
    assert float(history.windows[:, 0, 0].sum()) == 4
    assert float(history.draw(400, generator())[:, 0, 0].mean()) == pytest.approx(0.4, abs=0.08)


def test_the_distance_of_roots_is_that_of_the_decoded_motions():
    before, after = corpus().clips()[0][None, :30], corpus().clips()[2][None, :25]
    hips = [decode(clip[0], GroundPose.origin()).root_position[:25] for clip in (before, after)]
    expected = float((hips[0] - hips[1]).square().sum(-1).mean())
    assert float(compute_root_error(before, after)) == pytest.approx(expected, rel=1e-4)


def test_the_gap_to_mocap_is_a_sum_of_log_ratios_and_accuracy():
    assert compute_realism_gap({"a_ratio": 1.0, "classifier_accuracy": 0.4, "round": 7}) == 0
    assert compute_realism_gap({"a_ratio": 2.0}) == compute_realism_gap({"a_ratio": 0.5}) == pytest.approx(math.log(2))
    assert compute_realism_gap({"a_ratio": 1.0, "classifier_accuracy": 0.8}) == pytest.approx(0.6)
    assert compute_realism_gap({"a_ratio": None}) == math.inf


def test_a_rig_calibrated_otherwise_stands_as_still():
    still = Corpus(("a",), (16,), corpus(1, 16).features[:1].expand(16, -1).contiguous())
    drawn = draw_performers(FeatureWindows(still, 16, evenness=0.5), 20, generator())
    joints = LAYOUT.pick(drawn, "joint_rotations")
    assert 0.2 < ((joints - joints[:1]).abs().amax(dim=(1, 2)) > 0.05).double().mean() <= 1
    again = draw_performers(FeatureWindows(still, 16, evenness=0.5), 20, generator())
    assert torch.equal(drawn, again)


def test_an_untrained_denoiser_errs_by_as_much_as_the_corruption():
    parts = compute_denoiser_losses(tiny_denoiser.network(), corpus(1, 30).features[None], generator())
    assert all(bool(value.isfinite()) for value in parts.values())
    assert parts["contacts_nats"] == pytest.approx(math.log(2), rel=1e-3)


def test_an_infiller_is_compared_with_the_whole_motion():
    motion, network = PoseWindows(corpus(2, 60)).draw(4, 50, generator()), tiny_infiller.network()
    whole, holed = (compute_infiller_losses(network, motion, each) for each in (motion, with_gap(motion, 20, 30)))
    assert whole["error_cm"] == 0
    assert holed["error_cm"] > 1
    assert float(holed["position"]) == pytest.approx(float(whole["position"]), rel=1e-2)
    assert whole["position"] > 1


class TrueTrajectory(PathNetwork):
    """Answers with the motion's own steps, as they are or longer, and a height that is off."""

    def __init__(self, motion, stretch=1.0, higher=0.0):
        super().__init__(tiny_path.CONFIG)
        self.motion, self.stretch, self.higher = motion, stretch, higher

    def forward(self, motion: LocalMotion) -> RootTrajectory:
        root = self.motion.root_position
        steps = torch.diff(root[..., ::2], dim=1, prepend=root[:, :1, ::2])
        return RootTrajectory(self.stretch * steps, root[..., 1] + self.higher, 20 * (2 * self.motion.contacts - 1))


def test_a_path_costs_what_its_steps_sum_up_to_over_every_span_and_its_height():
    motion = PoseWindows(corpus(3, 100)).draw(2, 80, generator())
    motion = replace(motion, heading=torch.zeros_like(motion.heading))
    assert float(compute_path_losses(TrueTrajectory(motion), motion)["loss"]) < 0.02
    longer = compute_path_losses(TrueTrajectory(motion, stretch=1.1), motion)
    ground, spans = motion.root_position[..., ::2], (1, 2, 4, 8, 16, 32, 64)
    wanted = [10 * float((ground[:, span:] - ground[:, :-span]).norm(dim=-1).mean()) for span in spans]
    assert float(longer["path_cm"]) == pytest.approx(sum(wanted) / 7, rel=0.01)
    assert float(compute_path_losses(TrueTrajectory(motion, higher=-0.02), motion)["height_cm"]) == pytest.approx(2.0)


def test_a_transformer_that_is_untrained_errs_as_interpolation_does_and_a_true_answer_costs_nothing():
    truth = PoseWindows(corpus(2, 60)).draw(4, 40, generator())
    parts = compute_losses(tiny_transformer.network(), truth, truth)
    assert all(parts[name] < 1e-2 for name in ("positions_cm", "pace_cm", "turns"))
    hidden = with_gap(truth, 10, 25)
    shown = hide(tiny_transformer.network(), hidden)
    apart = (shown.world_poses()[0] - truth.world_poses()[0])[:, 10:25].norm(dim=-1)
    parts = compute_losses(tiny_transformer.network(), truth, hidden)
    assert float(parts["positions_cm"]) == pytest.approx(100 * float(apart.mean()), rel=1e-3)


@pytest.mark.parametrize("frames", [8, 40])
def test_parts_that_stay_known_are_the_motions_own(frames):
    truth = PoseWindows(corpus(2, 90)).draw(400, frames, generator())
    shown = sample_known_parts(truth, generator(1))
    known = shown.known
    assert bool((known.rotations | known.root[..., None]).any(dim=2).any(dim=1).all())
    assert float((~known.everything).any(dim=1).float().mean()) > 0.97
    assert float((shown.root_position - truth.root_position).norm(dim=-1)[~known.path].max()) == 0


class TrueMotion(GeneratorNetwork):
    """Answers with the motion itself, turned about the vertical by some radians."""

    def __init__(self, motion, turned=0.0):
        super().__init__(tiny_tweener.CONFIG)
        self.motion, self.turned = motion, turned

    def forward(self, image, style):
        local = self.motion.local_matrices()
        own = rotations.to_matrix(rotations.about_y(self.turned - image.heading))
        local = torch.cat([(own @ local[..., 0, :, :])[..., None, :, :], local[..., 1:, :, :]], dim=-3)
        return GeneratedPoses(ConstrainedPose(local, kinematics.positions_from_matrices(CANONICAL, local)), ())


@pytest.fixture(scope="module")
def windows():
    return PoseWindows(corpus(6, 150))


def tweener_losses(sequences, windows, turned=0.0):
    poses = draw_style_poses(windows, sequences, 0.0, generator())
    styled = torch.zeros(len(poses), dtype=torch.bool)
    network = TrueMotion(sequences.motion, turned)
    return compute_tweener_losses(network, tiny_path.network(), sequences, poses, styled)


@pytest.fixture
def whole_keys(monkeypatch):
    """Keys are whole poses."""
    for name in ("_HALVES", "_POSITION_KEYS", "_DRAWINGS"):
        monkeypatch.setattr(tweener, name, 0.0)


def test_a_tweener_pays_for_what_is_off_between_keys_of_one_clip(windows, whole_keys):
    sequences = draw_windows(windows, 3, 100, progress=1.0, generator=generator())
    found = tweener_losses(sequences, windows)
    assert all(float(found[name]) < 0.02 for name in ("positions_cm", "pace_cm", "feet_cm", "keys_cm", "turns"))
    turned = tweener_losses(sequences, windows, turned=0.1)
    positions = kinematics.positions_from_matrices(CANONICAL, sequences.motion.local_matrices())
    radius = positions[..., ::2].norm(dim=-1).mean()
    assert float(turned["positions_cm"]) == pytest.approx(100 * 2 * float(radius) * 0.05, rel=0.1)


def test_between_keys_of_different_clips_nothing_but_keys_counts(windows):
    sequences = draw_splices(windows, 2, 600, progress=1.0, generator=generator())
    hidden = ~sequences.truthful
    assert bool(hidden.any())
    quats = torch.where(hidden[..., None, None], sequences.motion.quats.roll(7, dims=1), sequences.motion.quats)
    other = replace(sequences, motion=replace(sequences.motion, quats=quats))
    poses, styled = draw_style_poses(windows, sequences, 0.0, generator()), torch.zeros(2, dtype=torch.bool)
    network = TrueMotion(sequences.motion)
    one, two = (
        compute_tweener_losses(network, tiny_path.network(), each, poses, styled) for each in (sequences, other)
    )
    assert float(one["loss"]) == pytest.approx(float(two["loss"]), rel=1e-4)


def gaps_of(known):
    """Last frame of a key, and the first of the next."""
    frames = known.nonzero()[:, 0].tolist()
    return [(one, other) for one, other in pairwise(frames) if other > one + 1]


def test_gaps_between_keys_grow_and_splices_lie_in_long_ones(windows, whole_keys):
    for progress, most in ((0.0, 30), (0.125, 120), (1.0, 130)):
        drawn = draw_windows(windows, 40, 130, progress=progress, generator=generator())
        longest = max(stop - start for row in drawn.known for start, stop in gaps_of(row))
        assert longest <= most
        assert bool(drawn.truthful.all())
    drawn, found = draw_splices(windows, 6, 700, progress=1.0, generator=generator()), 0
    for known, clip, truthful in zip(drawn.known, drawn.clip, drawn.truthful, strict=True):
        spliced = [(start, stop) for start, stop in gaps_of(known) if clip[start] != clip[stop]]
        found += len(spliced)
        assert all(stop - start >= 90 for start, stop in spliced)
        assert not any(bool(truthful[start + 1 : stop].any()) for start, stop in spliced)
    assert found > 3


class Answers(Inbetweener):
    """The truth, the interpolation, or that far off."""

    def __init__(self, truth=None, metres=0.0):
        self.truth, self.metres = truth, metres

    def propose(self, query, *, generator=None):
        motion = query.motion if self.truth is None else self.truth.pop(0)
        away = torch.tensor([0.0, self.metres, 0.0]) * query.nothing_known[:, None]
        return Proposal(
            replace(motion, root_position=motion.root_position + away), torch.zeros(motion.num_frames, 2), ""
        )


def test_gaps_in_unseen_clips_are_measured_beside_the_interpolation(monkeypatch):
    monkeypatch.setattr(gaps, "_WINDOWS", 3)
    clips = corpus(2, 60)
    found = gaps.measure_gaps(Answers(), clips, (5, 30, 50))
    assert [name for name in found if name.startswith("error")] == ["error_5_cm", "error_30_cm"]  # no clip has 70
    assert found["share_5"] == found["share_30"] == 1
    assert 0.1 < found["error_5_cm"] < found["error_30_cm"]
    starts = torch.linspace(0, 2 * (60 - 50 + 1) - 1, 3).long().tolist()
    first = [start if start < 11 else start + 49 for start in starts]
    windows = [clips.features[start : start + 50] for start in first]
    origin = GroundPose.origin(torch.float64)
    truth = [decode(window.double(), origin) for window in windows]
    found = gaps.measure_gaps(Answers(truth, metres=0.03), clips, (30,))
    assert found["error_30_cm"] == pytest.approx(3.0, abs=1e-4)


def test_clips_are_grouped_by_the_class_in_their_names():
    assert set(group_clips(("a/walk-1.bvh", "a/run-2.bvh"), "(walk|run)")) == {"walk", "run"}
    assert group_clips(("x.bvh",), LABELS) is not None


def test_the_fit_of_timings_finds_the_weights_of_the_pairs_but_for_a_few_wild_ones():
    features = torch.randn(2000, 4, generator=generator(), dtype=torch.float64)
    features[:, 0] = 1
    features[:, 2] = 5 + 0.1 * features[:, 2]
    wanted = torch.tensor([0.3, -0.2, 0.5, 0.1]).double()
    seconds = torch.exp(features @ wanted)
    seconds[::50] *= 20
    found = None
    for _ in range(15):
        found = solve_weights(PosePairs(features, torch.ones(2000), seconds), found)
    assert found is not None
    assert torch.allclose(features @ found, features @ wanted, atol=0.02)


@pytest.mark.parametrize("share", [0.17, 0.5])
def test_the_share_of_standing_windows_is_drawn_and_all_that_go(share):
    standing = corpus(1, 300).features.clone()
    standing[:, LAYOUT.slices["root_displacement_heading"]] = 0.0
    clips = Corpus(("a", "b"), (300, 120), torch.cat([standing, corpus(1, 120).features]))
    starts = find_window_starts(clips.lengths, 20)
    drawn = FeatureWindows(clips, 20, standing_share=share).draw(20_000, generator()).first
    stood, went = torch.bincount(torch.searchsorted(starts, drawn)).split([281, 101])
    assert float(stood.double().mean() / went.double().mean()) == pytest.approx(share, abs=0.05)
    assert int(went.min()) > 0


@pytest.mark.parametrize(("evenness", "share"), [(0.0, 0.9), (0.5, 0.75), (1.0, 0.5)])
def test_windows_are_evened_among_top_folders(evenness, share):
    clips = Corpus(("one/a", "two/b"), (919, 119), corpus(1, 1038).features)
    drawn = FeatureWindows(clips, 20, evenness=evenness).draw(4000, generator()).first
    assert float((drawn < 919).double().mean()) == pytest.approx(share, abs=0.03)


def test_spreads_are_calibrated_on_clips_a_little_longer_than_a_window(monkeypatch):
    monkeypatch.setattr(pose_transformer, "_CALIBRATED_WINDOWS", 60)
    network, clips = tiny_transformer.network(), Corpus(("a",), (95,), corpus(1, 95).features)
    assert all(bool(over.isfinite().all()) for over in pose_transformer._measure_spread(network, clips, seed=1))
